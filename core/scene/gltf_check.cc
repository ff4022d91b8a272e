#include "core/scene/gltf_check.h"

#include <array>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <initializer_list>
#include <limits>
#include <nlohmann/json.hpp>
#include <optional>
#include <set>
#include <utility>

namespace farpoint {

namespace {

using Json = nlohmann::json;

// tinygltf keeps sizes and indices in int here and there.
constexpr uint64_t kMaxInt = std::numeric_limits<int32_t>::max();
// Bytes of one encoded image; far above anything real, and below what the decoders take as int.
constexpr uint64_t kMaxImageBytes = uint64_t{1} << 28;
// Elements of an accessor without bufferView, whose zeros cost the file nothing.
constexpr uint64_t kMaxImplicitCount = uint64_t{1} << 24;
// Levels of objects and arrays; tinygltf reads extras by recursion.
constexpr int kMaxJsonDepth = 128;

// Keyframes that the channels of all animations read together.
constexpr uint64_t kMaxKeyframes = uint64_t{1} << 26;

constexpr const char* kSupportedExtensions[] = {
    "KHR_lights_punctual",     "KHR_materials_emissive_strength",
    "KHR_texture_transform",   "KHR_mesh_quantization",
    "EXT_mesh_gpu_instancing", "KHR_materials_pbrSpecularGlossiness",
    "KHR_materials_variants"};

// What to do about extensions that files require and that are not supported.
struct Advice {
  const char *extension, *text;
};
constexpr Advice kAdvice[] = {
    {"KHR_draco_mesh_compression", "decompress it, as with 'gltf-transform copy IN OUT'"},
    {"EXT_meshopt_compression", "decompress it, as with 'gltf-transform copy IN OUT'"},
    {"KHR_meshopt_compression", "decompress it, as with 'gltf-transform copy IN OUT'"},
    {"KHR_texture_basisu",
     "convert its textures to PNG or JPEG, as with 'gltf-transform png IN OUT'"},
    {"EXT_texture_webp",
     "convert its textures to PNG or JPEG, as with 'gltf-transform png IN OUT'"},
    {"EXT_texture_avif",
     "convert its textures to PNG or JPEG, as with 'gltf-transform png IN OUT'"}};

std::string AdviceFor(const std::string& extension) {
  for (const Advice& advice : kAdvice) {
    if (extension == advice.extension) return advice.text;
  }
  return "export the scene without it";
}

// What tinygltf decodes.
constexpr const char* kDataUriHeads[] = {"data:application/octet-stream;base64,",
                                         "data:application/gltf-buffer;base64,",
                                         "data:text/plain;base64,",
                                         "data:image/jpeg;base64,",
                                         "data:image/png;base64,",
                                         "data:image/bmp;base64,",
                                         "data:image/gif;base64,"};

// A JSON value and where it stands. The path is put together only for a message.
class Place {
 public:
  Place(const std::string& file, const Json& value) : file_(&file), value_(&value) {}
  Place(const Place& parent, const char* key, const Json& value)
      : file_(parent.file_), value_(&value), parent_(&parent), key_(key) {}
  Place(const Place& parent, size_t index, const Json& value)
      : file_(parent.file_), value_(&value), parent_(&parent), index_(index) {}

  const Json& value() const { return *value_; }
  std::string Path() const {
    if (parent_ == nullptr) return "";
    return parent_->Path() + "/" + (key_ != nullptr ? std::string(key_) : std::to_string(index_));
  }
  absl::Status Fail(const std::string& text) const {
    const std::string path = Path();
    return absl::InvalidArgumentError(*file_ + ": " + (path.empty() ? "/" : path) + ": " + text +
                                      "; correct the file or export it again");
  }
  // The member `key`, or nullptr. The value must be an object.
  const Json* Find(const char* key) const {
    const auto it = value_->find(key);
    return it == value_->end() ? nullptr : &*it;
  }
  Place Member(const char* key) const {
    const Json* found = Find(key);
    return Place(*this, key, found == nullptr ? *value_ : *found);
  }

 private:
  const std::string* file_;
  const Json* value_;
  const Place* parent_ = nullptr;
  const char* key_ = nullptr;
  size_t index_ = 0;
};

absl::Status WrongType(const Place& place, const std::string& expected) {
  return place.Fail("expected " + expected + ", found " + place.value().type_name());
}

absl::Status ReadUnsigned(const Place& parent, const char* key, uint64_t max,
                          std::optional<uint64_t>& out) {
  const Json* value = parent.Find(key);
  if (value == nullptr) return absl::OkStatus();
  const Place place(parent, key, *value);
  if (!value->is_number_integer()) return WrongType(place, "an integer");
  if (!value->is_number_unsigned() && value->get<int64_t>() < 0) {
    return place.Fail("is " + std::to_string(value->get<int64_t>()) + ", outside of [0, " +
                      std::to_string(max) + "]");
  }
  const uint64_t number = value->get<uint64_t>();
  if (number > max) {
    return place.Fail("is " + std::to_string(number) + ", outside of [0, " + std::to_string(max) +
                      "]");
  }
  out = number;
  return absl::OkStatus();
}

absl::Status RequireUnsigned(const Place& parent, const char* key, uint64_t max, uint64_t& out) {
  std::optional<uint64_t> number;
  FP_RETURN_IF_ERROR(ReadUnsigned(parent, key, max, number));
  if (!number) return parent.Fail("has no '" + std::string(key) + "'");
  out = *number;
  return absl::OkStatus();
}

// An index into an array of `size` elements.
absl::Status CheckIndexValue(const Place& place, size_t size, const char* what) {
  if (!place.value().is_number_integer())
    return WrongType(place, "an index into " + std::string(what));
  const bool negative = !place.value().is_number_unsigned() && place.value().get<int64_t>() < 0;
  if (negative || place.value().get<uint64_t>() >= size) {
    return place.Fail("index " + place.value().dump() + " is beyond the " + std::to_string(size) +
                      " " + what);
  }
  return absl::OkStatus();
}

absl::Status ReadIndex(const Place& parent, const char* key, size_t size, const char* what,
                       std::optional<size_t>& out) {
  const Json* value = parent.Find(key);
  if (value == nullptr) return absl::OkStatus();
  FP_RETURN_IF_ERROR(CheckIndexValue(Place(parent, key, *value), size, what));
  out = value->get<size_t>();
  return absl::OkStatus();
}

std::string Bound(double bound) {
  if (bound == std::numeric_limits<double>::min()) return "2.3e-308";
  char text[32];
  std::snprintf(text, sizeof(text), "%.7g", bound);
  return text;
}

absl::Status CheckNumberValue(const Place& place, double min, double max) {
  if (!place.value().is_number()) return WrongType(place, "a number");
  const double number = place.value().get<double>();
  if (!(number >= min && number <= max)) {
    return place.Fail("is " + place.value().dump() + ", outside of [" + Bound(min) + ", " +
                      Bound(max) + "]");
  }
  return absl::OkStatus();
}

constexpr double kHuge = std::numeric_limits<double>::max();

absl::Status CheckNumber(const Place& parent, const char* key, double min = -kHuge,
                         double max = kHuge) {
  const Json* value = parent.Find(key);
  if (value == nullptr) return absl::OkStatus();
  return CheckNumberValue(Place(parent, key, *value), min, max);
}

absl::Status CheckNumbers(const Place& parent, const char* key, size_t count, double min = -kHuge,
                          double max = kHuge) {
  const Json* value = parent.Find(key);
  if (value == nullptr) return absl::OkStatus();
  const Place place(parent, key, *value);
  if (!value->is_array()) return WrongType(place, "an array");
  if (value->size() != count) {
    return place.Fail("has " + std::to_string(value->size()) + " numbers instead of " +
                      std::to_string(count));
  }
  for (size_t i = 0; i < count; ++i) {
    FP_RETURN_IF_ERROR(CheckNumberValue(Place(place, i, (*value)[i]), min, max));
  }
  return absl::OkStatus();
}

absl::Status CheckString(const Place& parent, const char* key) {
  const Json* value = parent.Find(key);
  if (value == nullptr || value->is_string()) return absl::OkStatus();
  return WrongType(Place(parent, key, *value), "a string");
}

absl::Status CheckBoolean(const Place& parent, const char* key) {
  const Json* value = parent.Find(key);
  if (value == nullptr || value->is_boolean()) return absl::OkStatus();
  return WrongType(Place(parent, key, *value), "true or false");
}

// Calls body(place) for the member `key` if it is there; it must be an object.
template <typename Body>
absl::Status WithObject(const Place& parent, const char* key, const Body& body) {
  const Json* value = parent.Find(key);
  if (value == nullptr) return absl::OkStatus();
  const Place place(parent, key, *value);
  if (!value->is_object()) return WrongType(place, "an object");
  return body(place);
}

// Calls body(place) for each element of the array `key` if it is there; each must be an object.
template <typename Body>
absl::Status ForEachObject(const Place& parent, const char* key, const Body& body) {
  const Json* value = parent.Find(key);
  if (value == nullptr) return absl::OkStatus();
  const Place array(parent, key, *value);
  if (!value->is_array()) return WrongType(array, "an array");
  if (value->size() > kMaxInt) return array.Fail("has too many elements");
  for (size_t i = 0; i < value->size(); ++i) {
    const Place element(array, i, (*value)[i]);
    if (!element.value().is_object()) return WrongType(element, "an object");
    FP_RETURN_IF_ERROR(body(element));
  }
  return absl::OkStatus();
}

absl::Status CheckIndices(const Place& parent, const char* key, size_t size, const char* what) {
  const Json* value = parent.Find(key);
  if (value == nullptr) return absl::OkStatus();
  const Place array(parent, key, *value);
  if (!value->is_array()) return WrongType(array, "an array");
  for (size_t i = 0; i < value->size(); ++i) {
    FP_RETURN_IF_ERROR(CheckIndexValue(Place(array, i, (*value)[i]), size, what));
  }
  return absl::OkStatus();
}

size_t ArraySize(const Json& root, const char* key) {
  const auto it = root.find(key);
  return it == root.end() || !it->is_array() ? 0 : it->size();
}

// nlohmann parses without recursion but destroys and copies with it, and so does tinygltf.
absl::Status CheckDepth(const std::string& name, std::string_view text) {
  int depth = 0;
  bool in_string = false;
  for (size_t i = 0; i < text.size(); ++i) {
    const char c = text[i];
    if (in_string) {
      if (c == '\\')
        ++i;
      else if (c == '"')
        in_string = false;
    } else if (c == '"') {
      in_string = true;
    } else if (c == '{' || c == '[') {
      if (++depth > kMaxJsonDepth) {
        return absl::InvalidArgumentError(
            name + ": byte " + std::to_string(i) + " of the JSON: objects and arrays are nested " +
            "more than " + std::to_string(kMaxJsonDepth) + " deep; simplify the extras");
      }
    } else if (c == '}' || c == ']') {
      --depth;
    }
  }
  return absl::OkStatus();
}

absl::StatusOr<Json> ParseJson(const std::string& name, std::string_view text) {
  FP_RETURN_IF_ERROR(CheckDepth(name, text));
  try {
    Json root = Json::parse(text.begin(), text.end());
    if (!root.is_object()) {
      return absl::InvalidArgumentError(name + ": /: expected an object, found " +
                                        root.type_name() + "; this is not a glTF file");
    }
    return root;
  } catch (const std::exception& e) {
    // nlohmann's text has line and column: "[json.exception.parse_error.101] parse error at …".
    std::string what = e.what();
    if (const size_t end = what.find("] "); end != std::string::npos) what = what.substr(end + 2);
    return absl::InvalidArgumentError(name + ": malformed JSON: " + what +
                                      "; correct the file or export it again");
  }
}

std::optional<std::string> SchemeOf(std::string_view uri) {
  for (size_t i = 0; i < uri.size(); ++i) {
    const char c = uri[i];
    if (c == ':' && i > 1) return std::string(uri.substr(0, i));  // one letter: a drive
    const bool alpha = (c >= 'a' && c <= 'z') || (c >= 'A' && c <= 'Z');
    const bool other = (c >= '0' && c <= '9') || c == '+' || c == '-' || c == '.';
    if (!alpha && !(i > 0 && other)) return std::nullopt;
  }
  return std::nullopt;
}

// A relative path that stays in the folder.
absl::Status CheckRelative(const Place& place, const std::string& decoded) {
  if (decoded.empty()) return place.Fail("is empty");
  if (decoded.find('\0') != std::string::npos) return place.Fail("holds a zero byte");
  if (decoded[0] == '/' || decoded[0] == '\\' || (decoded.size() > 1 && decoded[1] == ':')) {
    return place.Fail("'" + decoded + "' is an absolute path; put the file beside the scene");
  }
  int level = 0;
  size_t begin = 0;
  while (begin <= decoded.size()) {
    const size_t end = std::min(decoded.find_first_of("/\\", begin), decoded.size());
    const std::string_view part = std::string_view(decoded).substr(begin, end - begin);
    if (part == "..")
      --level;
    else if (!part.empty() && part != ".")
      ++level;
    if (level < 0) {
      return place.Fail("'" + decoded + "' leaves the scene's folder; put the file into it");
    }
    begin = end + 1;
  }
  return absl::OkStatus();
}

// The decoded URI at `place`; empty for data: URIs.
absl::StatusOr<std::string> ReadExternalUri(const Place& place) {
  if (!place.value().is_string()) return WrongType(place, "a string");
  const std::string& uri = place.value().get_ref<const std::string&>();
  if (IsDataUri(uri)) return std::string();
  if (const auto scheme = SchemeOf(uri)) {
    return place.Fail("URIs of scheme '" + *scheme +
                      ":' are not followed; download the file and "
                      "put it beside the scene");
  }
  std::string decoded = DecodeUri(uri);
  FP_RETURN_IF_ERROR(CheckRelative(place, decoded));
  return decoded;
}

bool IsBase64(char c) {
  return (c >= 'A' && c <= 'Z') || (c >= 'a' && c <= 'z') || (c >= '0' && c <= '9') || c == '+' ||
         c == '/';
}

// The number of bytes that a data: URI holds, after checking its form.
absl::StatusOr<uint64_t> DataUriSize(const Place& place) {
  const std::string& uri = place.value().get_ref<const std::string&>();
  for (const std::string_view head : kDataUriHeads) {
    if (uri.compare(0, head.size(), head) != 0) continue;
    size_t end = uri.size();
    while (end > head.size() && uri[end - 1] == '=') --end;
    const size_t digits = end - head.size();
    for (size_t i = head.size(); i < end; ++i) {
      if (!IsBase64(uri[i])) {
        return place.Fail("character " + std::to_string(i) + " is not part of base64");
      }
    }
    if (digits % 4 == 1 || uri.size() - end > 2) return place.Fail("its base64 has a wrong length");
    return digits * 3 / 4;
  }
  return place.Fail("'" + uri.substr(0, 48) +
                    "…' is not base64 data of a type that glTF allows (application/octet-stream, "
                    "application/gltf-buffer, image/png, image/jpeg)");
}

uint64_t ComponentSize(uint64_t component_type) {
  switch (component_type) {
    case 5120:
    case 5121:
      return 1;
    case 5122:
    case 5123:
      return 2;
    case 5125:
    case 5126:
      return 4;
    default:
      return 0;
  }
}

uint64_t ComponentCount(const std::string& type) {
  if (type == "SCALAR") return 1;
  if (type == "VEC2") return 2;
  if (type == "VEC3") return 3;
  if (type == "VEC4" || type == "MAT2") return 4;
  if (type == "MAT3") return 9;
  if (type == "MAT4") return 16;
  return 0;
}

// Columns of matrices start at multiples of 4 bytes.
uint64_t ElementSize(const std::string& type, uint64_t component_size) {
  if (type == "MAT2" && component_size == 1) return 8;
  if (type == "MAT3" && component_size == 1) return 12;
  if (type == "MAT3" && component_size == 2) return 24;
  return ComponentCount(type) * component_size;
}

class Checker {
 public:
  Checker(const AssetBundle& asset, const GltfContainer& container, const Json& root)
      : asset_(asset), container_(container), name_(asset.root), json_(root), root_(name_, root) {}

  absl::Status Run() {
    FP_RETURN_IF_ERROR(CheckAsset());
    FP_RETURN_IF_ERROR(CheckExtensions());
    FP_RETURN_IF_ERROR(CheckBuffers());
    FP_RETURN_IF_ERROR(CheckBufferViews());
    FP_RETURN_IF_ERROR(
        ForEachObject(root_, "accessors", [&](const Place& p) { return CheckAccessor(p); }));
    FP_RETURN_IF_ERROR(
        ForEachObject(root_, "images", [&](const Place& p) { return CheckImage(p); }));
    FP_RETURN_IF_ERROR(
        ForEachObject(root_, "samplers", [&](const Place& p) { return CheckSampler(p); }));
    FP_RETURN_IF_ERROR(ForEachObject(root_, "textures", [&](const Place& p) -> absl::Status {
      std::optional<size_t> index;
      FP_RETURN_IF_ERROR(ReadIndex(p, "source", Size("images"), "images", index));
      FP_RETURN_IF_ERROR(ReadIndex(p, "sampler", Size("samplers"), "samplers", index));
      return CheckString(p, "name");
    }));
    FP_RETURN_IF_ERROR(
        ForEachObject(root_, "materials", [&](const Place& p) { return CheckMaterial(p); }));
    FP_RETURN_IF_ERROR(
        ForEachObject(root_, "meshes", [&](const Place& p) { return CheckMesh(p); }));
    FP_RETURN_IF_ERROR(
        ForEachObject(root_, "cameras", [&](const Place& p) { return CheckCamera(p); }));
    FP_RETURN_IF_ERROR(CheckLights());
    FP_RETURN_IF_ERROR(ForEachObject(root_, "skins", [&](const Place& p) { return CheckSkin(p); }));
    FP_RETURN_IF_ERROR(ForEachObject(root_, "nodes", [&](const Place& p) { return CheckNode(p); }));
    FP_RETURN_IF_ERROR(
        ForEachObject(root_, "animations", [&](const Place& p) { return CheckAnimation(p); }));
    FP_RETURN_IF_ERROR(ForEachObject(root_, "scenes", [&](const Place& p) -> absl::Status {
      FP_RETURN_IF_ERROR(CheckString(p, "name"));
      FP_RETURN_IF_ERROR(CheckSky(p));
      return CheckIndices(p, "nodes", Size("nodes"), "nodes");
    }));
    std::optional<size_t> scene;
    return ReadIndex(root_, "scene", Size("scenes"), "scenes", scene);
  }
  std::vector<GltfBufferFile> TakeBufferFiles() { return std::move(buffer_files_); }

 private:
  size_t Size(const char* key) const { return ArraySize(json_, key); }

  absl::Status CheckAsset() {
    const Json* asset = root_.Find("asset");
    if (asset == nullptr) return root_.Fail("has no 'asset': this is not a glTF 2.0 file");
    const Place place(root_, "asset", *asset);
    if (!asset->is_object()) return WrongType(place, "an object");
    FP_RETURN_IF_ERROR(CheckString(place, "version"));
    FP_RETURN_IF_ERROR(CheckString(place, "minVersion"));
    const Json* version = place.Find("version");
    if (version == nullptr) return place.Fail("has no 'version'");
    if (version->get<std::string>().rfind("2.", 0) != 0) {
      return place.Member("version").Fail("is '" + version->get<std::string>() +
                                          "'; only glTF 2.0 is read");
    }
    const Json* min_version = place.Find("minVersion");
    if (min_version != nullptr && min_version->get<std::string>() != "2.0") {
      return place.Member("minVersion")
          .Fail("is '" + min_version->get<std::string>() + "'; only glTF 2.0 is read");
    }
    return absl::OkStatus();
  }

  absl::Status CheckExtensions() {
    for (const char* key : {"extensionsUsed", "extensionsRequired"}) {
      const Json* list = root_.Find(key);
      if (list == nullptr) continue;
      const Place place(root_, key, *list);
      if (!list->is_array()) return WrongType(place, "an array");
      for (size_t i = 0; i < list->size(); ++i) {
        const Place element(place, i, (*list)[i]);
        if (!element.value().is_string()) return WrongType(element, "a string");
        if (std::strcmp(key, "extensionsRequired") != 0) continue;
        const std::string extension = element.value().get<std::string>();
        bool supported = false;
        for (const char* known : kSupportedExtensions) supported |= extension == known;
        if (!supported) {
          return absl::UnimplementedError(
              name_ + ": " + element.Path() + ": the file requires the extension '" + extension +
              "', which farpoint does not support; " + AdviceFor(extension));
        }
      }
    }
    return absl::OkStatus();
  }

  absl::Status CheckBuffers() {
    size_t index = 0;
    return ForEachObject(root_, "buffers", [&](const Place& place) -> absl::Status {
      uint64_t length = 0;
      FP_RETURN_IF_ERROR(RequireUnsigned(place, "byteLength", uint64_t{1} << 40, length));
      FP_RETURN_IF_ERROR(CheckString(place, "name"));
      uint64_t available = 0;
      std::string source;
      const Json* uri = place.Find("uri");
      if (uri == nullptr) {
        if (!container_.binary || index != 0) {
          return place.Fail(container_.binary ? "only buffer 0 may be without 'uri'"
                                              : "has no 'uri'");
        }
        available = container_.bin.size();
        source = "the BIN chunk";
      } else {
        const Place uri_place(place, "uri", *uri);
        FP_ASSIGN_OR_RETURN(const std::string external, ReadExternalUri(uri_place));
        if (external.empty()) {
          FP_ASSIGN_OR_RETURN(available, DataUriSize(uri_place));
          if (available < length) {
            return uri_place.Fail("holds " + std::to_string(available) + " bytes, fewer than the " +
                                  std::to_string(length) + " of byteLength");
          }
          // tinygltf insists on equality.
          if (available != length) {
            return uri_place.Fail("holds " + std::to_string(available) + " bytes, more than the " +
                                  std::to_string(length) + " of byteLength");
          }
        } else {
          const auto file = asset_.Find(external);
          if (!file.ok()) return Annotate(file.status(), name_ + ": " + uri_place.Path());
          available = file->size();
          buffer_files_.push_back({uri->get<std::string>(), length});
          source = "'" + external + "'";
        }
      }
      if (available < length) {
        return place.Fail(source + " has " + std::to_string(available) + " bytes, fewer than the " +
                          std::to_string(length) + " of byteLength");
      }
      if (length == 0) return place.Member("byteLength").Fail("is 0");
      buffer_sizes_.push_back(length);
      ++index;
      return absl::OkStatus();
    });
  }

  absl::Status CheckBufferViews() {
    return ForEachObject(root_, "bufferViews", [&](const Place& place) -> absl::Status {
      std::optional<size_t> buffer;
      FP_RETURN_IF_ERROR(ReadIndex(place, "buffer", buffer_sizes_.size(), "buffers", buffer));
      if (!buffer) return place.Fail("has no 'buffer'");
      std::optional<uint64_t> offset, stride, target;
      uint64_t length = 0;
      FP_RETURN_IF_ERROR(ReadUnsigned(place, "byteOffset", uint64_t{1} << 40, offset));
      FP_RETURN_IF_ERROR(RequireUnsigned(place, "byteLength", uint64_t{1} << 40, length));
      FP_RETURN_IF_ERROR(ReadUnsigned(place, "byteStride", 252, stride));
      FP_RETURN_IF_ERROR(ReadUnsigned(place, "target", kMaxInt, target));
      FP_RETURN_IF_ERROR(CheckString(place, "name"));
      const uint64_t size = buffer_sizes_[*buffer];
      if (length == 0) return place.Member("byteLength").Fail("is 0");
      if (offset.value_or(0) > size || length > size - offset.value_or(0)) {
        return place.Fail("bytes " + std::to_string(offset.value_or(0)) + " to " +
                          std::to_string(offset.value_or(0) + length) + " are beyond the " +
                          std::to_string(size) + " bytes of buffer " + std::to_string(*buffer));
      }
      if (stride && (*stride < 4 || *stride % 4 != 0)) {
        return place.Member("byteStride")
            .Fail("is " + std::to_string(*stride) + " instead of a multiple of 4 in [4, 252]");
      }
      views_.push_back({length, stride.value_or(0)});
      return absl::OkStatus();
    });
  }

  // `count` elements of `size` bytes, `stride` apart, from `offset` of a view.
  absl::Status CheckRange(const Place& place, size_t view, uint64_t offset, uint64_t count,
                          uint64_t stride, uint64_t size) {
    const uint64_t length = views_[view].length;
    if (count == 0) return absl::OkStatus();
    // count < 2^40, stride <= 252: no overflow.
    if (offset > length || (count - 1) * stride + size > length - offset) {
      return place.Fail("its " + std::to_string(count) + " elements of " + std::to_string(size) +
                        " bytes, " + std::to_string(stride) + " apart from byte " +
                        std::to_string(offset) + ", are beyond the " + std::to_string(length) +
                        " bytes of bufferView " + std::to_string(view));
    }
    return absl::OkStatus();
  }

  absl::Status CheckAccessor(const Place& place) {
    std::optional<size_t> view;
    std::optional<uint64_t> offset;
    uint64_t component_type = 0, count = 0;
    FP_RETURN_IF_ERROR(ReadIndex(place, "bufferView", views_.size(), "bufferViews", view));
    FP_RETURN_IF_ERROR(ReadUnsigned(place, "byteOffset", uint64_t{1} << 40, offset));
    FP_RETURN_IF_ERROR(RequireUnsigned(place, "componentType", kMaxInt, component_type));
    FP_RETURN_IF_ERROR(RequireUnsigned(place, "count", uint64_t{1} << 36, count));
    FP_RETURN_IF_ERROR(CheckBoolean(place, "normalized"));
    FP_RETURN_IF_ERROR(CheckString(place, "name"));
    FP_RETURN_IF_ERROR(CheckString(place, "type"));
    const Json* type = place.Find("type");
    if (type == nullptr) return place.Fail("has no 'type'");
    const uint64_t component_size = ComponentSize(component_type);
    if (component_size == 0) {
      return place.Member("componentType")
          .Fail("is " + std::to_string(component_type) +
                " instead of 5120, 5121, 5122, 5123, 5125 or 5126");
    }
    const std::string type_name = type->get<std::string>();
    if (ComponentCount(type_name) == 0) {
      return place.Member("type").Fail("is '" + type_name +
                                       "' instead of SCALAR, VEC2, VEC3, VEC4, MAT2, MAT3 or MAT4");
    }
    const uint64_t size = ElementSize(type_name, component_size);
    if (view) {
      const uint64_t stride = views_[*view].stride == 0 ? size : views_[*view].stride;
      if (count > 1 && stride < size) {
        return place.Fail("elements of " + std::to_string(size) + " bytes do not fit the " +
                          std::to_string(stride) + " bytes of byteStride of bufferView " +
                          std::to_string(*view));
      }
      FP_RETURN_IF_ERROR(CheckRange(place, *view, offset.value_or(0), count, stride, size));
    } else if (count > kMaxImplicitCount) {
      return place.Fail("has " + std::to_string(count) + " elements but no bufferView");
    }
    return WithObject(place, "sparse", [&](const Place& sparse) -> absl::Status {
      uint64_t sparse_count = 0;
      FP_RETURN_IF_ERROR(RequireUnsigned(sparse, "count", std::min(count, kMaxInt), sparse_count));
      for (const char* key : {"indices", "values"}) {
        if (sparse.Find(key) == nullptr) return sparse.Fail("has no '" + std::string(key) + "'");
        const bool indices = std::strcmp(key, "indices") == 0;
        FP_RETURN_IF_ERROR(WithObject(sparse, key, [&](const Place& part) -> absl::Status {
          std::optional<size_t> part_view;
          std::optional<uint64_t> part_offset;
          uint64_t part_size = size;
          FP_RETURN_IF_ERROR(
              ReadIndex(part, "bufferView", views_.size(), "bufferViews", part_view));
          if (!part_view) return part.Fail("has no 'bufferView'");
          FP_RETURN_IF_ERROR(ReadUnsigned(part, "byteOffset", kMaxInt, part_offset));
          if (indices) {
            uint64_t index_type = 0;
            FP_RETURN_IF_ERROR(RequireUnsigned(part, "componentType", kMaxInt, index_type));
            if (index_type != 5121 && index_type != 5123 && index_type != 5125) {
              return part.Member("componentType")
                  .Fail("is " + std::to_string(index_type) + " instead of 5121, 5123 or 5125");
            }
            part_size = ComponentSize(index_type);
          }
          return CheckRange(part, *part_view, part_offset.value_or(0), sparse_count, part_size,
                            part_size);
        }));
      }
      return absl::OkStatus();
    });
  }

  absl::Status CheckImage(const Place& place) {
    std::optional<size_t> view;
    std::optional<uint64_t> ignored;
    FP_RETURN_IF_ERROR(ReadIndex(place, "bufferView", views_.size(), "bufferViews", view));
    FP_RETURN_IF_ERROR(CheckString(place, "name"));
    FP_RETURN_IF_ERROR(CheckString(place, "mimeType"));
    for (const char* key : {"width", "height"}) {
      FP_RETURN_IF_ERROR(ReadUnsigned(place, key, kMaxInt, ignored));
    }
    const Json* uri = place.Find("uri");
    if ((uri != nullptr) == view.has_value()) {
      return place.Fail("needs either 'uri' or 'bufferView'");
    }
    uint64_t size = 0;
    if (view) {
      size = views_[*view].length;
    } else {
      const Place uri_place(place, "uri", *uri);
      FP_ASSIGN_OR_RETURN(const std::string external, ReadExternalUri(uri_place));
      if (external.empty()) {
        FP_ASSIGN_OR_RETURN(size, DataUriSize(uri_place));
        if (size == 0) return uri_place.Fail("holds no bytes");
      } else if (const auto it = asset_.files.find(external); it != asset_.files.end()) {
        size = it->second.size();
      }
    }
    if (size > kMaxImageBytes) {
      return place.Fail("has " + std::to_string(size) + " bytes, more than " +
                        std::to_string(kMaxImageBytes));
    }
    return absl::OkStatus();
  }

  absl::Status CheckSampler(const Place& place) {
    for (const char* key : {"magFilter", "minFilter", "wrapS", "wrapT"}) {
      std::optional<uint64_t> value;
      FP_RETURN_IF_ERROR(ReadUnsigned(place, key, kMaxInt, value));
      if (key[0] == 'w' && value && *value != 10497 && *value != 33071 && *value != 33648) {
        return place.Member(key).Fail("is " + std::to_string(*value) +
                                      " instead of 10497, 33071 or 33648");
      }
    }
    return CheckString(place, "name");
  }

  absl::Status CheckTextureInfo(const Place& parent, const char* key) {
    return WithObject(parent, key, [&](const Place& info) -> absl::Status {
      std::optional<size_t> index;
      std::optional<uint64_t> uv_set;
      FP_RETURN_IF_ERROR(ReadIndex(info, "index", Size("textures"), "textures", index));
      if (!index) return info.Fail("has no 'index'");
      FP_RETURN_IF_ERROR(ReadUnsigned(info, "texCoord", kMaxInt, uv_set));
      return WithObject(info, "extensions", [&](const Place& extensions) {
        return WithObject(extensions, "KHR_texture_transform",
                          [&](const Place& transform) -> absl::Status {
                            FP_RETURN_IF_ERROR(CheckNumbers(transform, "offset", 2, -1e9, 1e9));
                            FP_RETURN_IF_ERROR(CheckNumbers(transform, "scale", 2, -1e9, 1e9));
                            FP_RETURN_IF_ERROR(CheckNumber(transform, "rotation", -1e6, 1e6));
                            return ReadUnsigned(transform, "texCoord", kMaxInt, uv_set);
                          });
      });
    });
  }

  absl::Status CheckMaterial(const Place& place) {
    FP_RETURN_IF_ERROR(CheckString(place, "name"));
    FP_RETURN_IF_ERROR(
        WithObject(place, "pbrMetallicRoughness", [&](const Place& pbr) -> absl::Status {
          FP_RETURN_IF_ERROR(CheckNumbers(pbr, "baseColorFactor", 4, 0, 1e6));
          FP_RETURN_IF_ERROR(CheckNumber(pbr, "metallicFactor", 0, 1));
          FP_RETURN_IF_ERROR(CheckNumber(pbr, "roughnessFactor", 0, 1));
          FP_RETURN_IF_ERROR(CheckTextureInfo(pbr, "metallicRoughnessTexture"));
          return CheckTextureInfo(pbr, "baseColorTexture");
        }));
    FP_RETURN_IF_ERROR(CheckNumbers(place, "emissiveFactor", 3, 0, 1e12));
    FP_RETURN_IF_ERROR(CheckTextureInfo(place, "emissiveTexture"));
    FP_RETURN_IF_ERROR(CheckTextureInfo(place, "normalTexture"));
    FP_RETURN_IF_ERROR(WithObject(place, "normalTexture", [&](const Place& normal) {
      return CheckNumber(normal, "scale", -1e6, 1e6);
    }));
    FP_RETURN_IF_ERROR(CheckTextureInfo(place, "occlusionTexture"));
    FP_RETURN_IF_ERROR(CheckNumber(place, "alphaCutoff", 0, 1e6));
    FP_RETURN_IF_ERROR(CheckBoolean(place, "doubleSided"));
    FP_RETURN_IF_ERROR(CheckString(place, "alphaMode"));
    if (const Json* mode = place.Find("alphaMode")) {
      const std::string name = mode->get<std::string>();
      if (name != "OPAQUE" && name != "MASK" && name != "BLEND") {
        return place.Member("alphaMode").Fail("is '" + name + "' instead of OPAQUE, MASK or BLEND");
      }
    }
    return WithObject(place, "extensions", [&](const Place& extensions) {
      FP_RETURN_IF_ERROR(WithObject(
          extensions, "KHR_materials_pbrSpecularGlossiness", [&](const Place& pbr) -> absl::Status {
            FP_RETURN_IF_ERROR(CheckNumbers(pbr, "diffuseFactor", 4, 0, 1e6));
            return CheckTextureInfo(pbr, "diffuseTexture");
          }));
      FP_RETURN_IF_ERROR(WithObject(extensions, "KHR_materials_ior", [&](const Place& ior) {
        return CheckNumber(ior, "ior", 0, 1e6);
      }));
      return WithObject(extensions, "KHR_materials_emissive_strength", [&](const Place& strength) {
        return CheckNumber(strength, "emissiveStrength", 0, 1e12);
      });
    });
  }

  absl::Status CheckMesh(const Place& place) {
    FP_RETURN_IF_ERROR(CheckString(place, "name"));
    if (place.Find("primitives") == nullptr) return place.Fail("has no 'primitives'");
    if (const Json* weights = place.Find("weights"); weights != nullptr) {
      FP_RETURN_IF_ERROR(CheckNumbers(place, "weights", weights->size(), -1e9, 1e9));
    }
    // A mesh's morph targets are counted by its first primitive.
    morph_targets_.push_back(0);
    bool first = true;
    return ForEachObject(place, "primitives", [&](const Place& primitive) -> absl::Status {
      std::optional<size_t> index;
      std::optional<uint64_t> mode;
      FP_RETURN_IF_ERROR(ReadIndex(primitive, "material", Size("materials"), "materials", index));
      FP_RETURN_IF_ERROR(ReadUnsigned(primitive, "mode", 6, mode));
      index.reset();
      FP_RETURN_IF_ERROR(ReadIndex(primitive, "indices", Size("accessors"), "accessors", index));
      if (index) {
        const Place indices = primitive.Member("indices");
        const Json& accessor = json_["accessors"][*index];
        const std::string accessor_name = "accessor " + std::to_string(*index);
        const uint64_t type = accessor["componentType"].get<uint64_t>();
        if (accessor["type"] != "SCALAR" || (type != 5121 && type != 5123 && type != 5125)) {
          return indices.Fail(accessor_name + " is not SCALAR of componentType 5121, 5123 or 5125");
        }
        if (!accessor.contains("bufferView"))
          return indices.Fail(accessor_name + " has no bufferView");
      }
      if (primitive.Find("attributes") == nullptr) return primitive.Fail("has no 'attributes'");
      std::optional<uint64_t> positions;
      FP_RETURN_IF_ERROR(WithObject(primitive, "attributes", [&](const Place& attributes) {
        return CheckAttributes(attributes, positions);
      }));
      return CheckTargets(primitive, positions, first);
    });
  }

  absl::Status CheckTargets(const Place& primitive, std::optional<uint64_t> positions,
                            bool& first) {
    size_t targets = 0;
    FP_RETURN_IF_ERROR(
        ForEachObject(primitive, "targets", [&](const Place& target) -> absl::Status {
          ++targets;
          for (const auto& [key, value] : target.value().items()) {
            const Place place(target, key.c_str(), value);
            FP_RETURN_IF_ERROR(CheckIndexValue(place, Size("accessors"), "accessors"));
            const Json& accessor = json_["accessors"][value.get<size_t>()];
            if (key != "POSITION" && key != "NORMAL") continue;
            if (accessor["type"] != "VEC3" || accessor["componentType"] == 5125) {
              return place.Fail("accessor " + value.dump() +
                                " is not VEC3 of floats or integers of 8 or 16 bits");
            }
            const uint64_t count = accessor["count"].get<uint64_t>();
            if (positions && count != *positions) {
              return place.Fail("has " + std::to_string(count) + " elements for " +
                                std::to_string(*positions) + " positions");
            }
          }
          return absl::OkStatus();
        }));
    if (first) morph_targets_.back() = targets;
    first = false;
    if (targets != morph_targets_.back()) {
      return primitive.Fail("has " + std::to_string(targets) + " morph targets where the first " +
                            "primitive of the mesh has " + std::to_string(morph_targets_.back()));
    }
    return absl::OkStatus();
  }

  // An accessor by its index in `place`, of one of the types and component types. Integers other
  // than the plain ones must be normalised.
  absl::Status CheckKind(const Place& place, std::initializer_list<const char*> types,
                         std::initializer_list<int> plain, std::initializer_list<int> normalized,
                         uint64_t& count) {
    FP_RETURN_IF_ERROR(CheckIndexValue(place, Size("accessors"), "accessors"));
    const Json& accessor = json_["accessors"][place.value().get<size_t>()];
    const int component_type = accessor["componentType"].get<int>();
    const bool is_normalized = accessor.value("normalized", false);
    std::string expected;
    bool type_fits = false, component_fits = false;
    for (const char* type : types) {
      type_fits |= accessor["type"] == type;
      expected += (expected.empty() ? "" : " or ") + std::string(type);
    }
    expected += " of componentType";
    for (const int type : plain) {
      component_fits |= component_type == type && !is_normalized;
      expected += " " + std::to_string(type);
    }
    for (const int type : normalized) {
      component_fits |= component_type == type && is_normalized;
      expected += " " + std::to_string(type) + " (normalized)";
    }
    if (!type_fits || !component_fits) {
      return place.Fail("accessor " + place.value().dump() + " is not " + expected);
    }
    count = accessor["count"].get<uint64_t>();
    return absl::OkStatus();
  }

  absl::Status CheckAttributes(const Place& attributes, std::optional<uint64_t>& positions) {
    for (const auto& [key, value] : attributes.value().items()) {
      const Place place(attributes, key.c_str(), value);
      FP_RETURN_IF_ERROR(CheckIndexValue(place, Size("accessors"), "accessors"));
      const Json& accessor = json_["accessors"][value.get<size_t>()];
      const bool vector3 = key == "POSITION" || key == "NORMAL";
      if (vector3 && accessor["type"] != "VEC3") {
        return place.Fail("accessor " + value.dump() + " is not VEC3");
      }
      if (key.rfind("TEXCOORD_", 0) == 0 && accessor["type"] != "VEC2") {
        return place.Fail("accessor " + value.dump() + " is not VEC2");
      }
      if ((vector3 || key.rfind("TEXCOORD_", 0) == 0) && accessor["componentType"] == 5125) {
        return place.Fail("accessor " + value.dump() + " holds 32-bit integers");
      }
      uint64_t count = 0;
      if (key.rfind("COLOR_", 0) == 0) {
        FP_RETURN_IF_ERROR(CheckKind(place, {"VEC3", "VEC4"}, {5126}, {5121, 5123}, count));
      } else if (key.rfind("JOINTS_", 0) == 0) {
        FP_RETURN_IF_ERROR(CheckKind(place, {"VEC4"}, {5121, 5123}, {}, count));
      } else if (key.rfind("WEIGHTS_", 0) == 0) {
        FP_RETURN_IF_ERROR(CheckKind(place, {"VEC4"}, {5126}, {5121, 5123}, count));
      }
      if (key == "POSITION") positions = accessor["count"].get<uint64_t>();
    }
    if (!positions) return absl::OkStatus();
    for (const auto& [key, value] : attributes.value().items()) {
      const uint64_t count = json_["accessors"][value.get<size_t>()]["count"].get<uint64_t>();
      if (count != *positions) {
        return Place(attributes, key.c_str(), value)
            .Fail("has " + std::to_string(count) + " elements for " + std::to_string(*positions) +
                  " positions");
      }
    }
    return absl::OkStatus();
  }

  absl::Status CheckCamera(const Place& place) {
    FP_RETURN_IF_ERROR(CheckString(place, "name"));
    FP_RETURN_IF_ERROR(CheckString(place, "type"));
    const Json* type = place.Find("type");
    if (type == nullptr) return place.Fail("has no 'type'");
    const std::string name = type->get<std::string>();
    if (name != "perspective" && name != "orthographic") {
      return place.Member("type").Fail("is '" + name + "' instead of perspective or orthographic");
    }
    if (place.Find(name.c_str()) == nullptr) return place.Fail("has no '" + name + "'");
    return WithObject(place, name.c_str(), [&](const Place& p) -> absl::Status {
      if (name == "perspective") {
        if (p.Find("yfov") == nullptr) return p.Fail("has no 'yfov'");
        FP_RETURN_IF_ERROR(CheckNumber(p, "yfov", std::numeric_limits<double>::min(), 3.1415));
        FP_RETURN_IF_ERROR(CheckNumber(p, "aspectRatio"));
      } else {
        FP_RETURN_IF_ERROR(CheckNumber(p, "xmag"));
        FP_RETURN_IF_ERROR(CheckNumber(p, "ymag"));
      }
      // tinygltf refuses a camera without them; their values clip nothing.
      if (p.Find("znear") == nullptr) return p.Fail("has no 'znear'");
      if (name == "orthographic" && p.Find("zfar") == nullptr) return p.Fail("has no 'zfar'");
      FP_RETURN_IF_ERROR(CheckNumber(p, "znear"));
      return CheckNumber(p, "zfar");
    });
  }

  absl::Status CheckLights() {
    return WithObject(root_, "extensions", [&](const Place& extensions) {
      return WithObject(extensions, "KHR_lights_punctual", [&](const Place& lights) {
        light_count_ = ArraySize(lights.value(), "lights");
        return ForEachObject(lights, "lights", [&](const Place& light) -> absl::Status {
          FP_RETURN_IF_ERROR(CheckString(light, "name"));
          FP_RETURN_IF_ERROR(CheckString(light, "type"));
          const Json* type = light.Find("type");
          if (type == nullptr) return light.Fail("has no 'type'");
          const std::string name = type->get<std::string>();
          if (name != "point" && name != "spot" && name != "directional") {
            return light.Member("type").Fail("is '" + name +
                                             "' instead of point, spot or directional");
          }
          if (const Json* color = light.Find("color"); color != nullptr && !color->empty()) {
            FP_RETURN_IF_ERROR(CheckNumbers(light, "color", 3, 0, 1e12));
          }
          FP_RETURN_IF_ERROR(CheckNumber(light, "intensity", 0, 1e24));
          FP_RETURN_IF_ERROR(CheckNumber(light, "range", 0, kHuge));
          if (name == "spot" && light.Find("spot") == nullptr) return light.Fail("has no 'spot'");
          return WithObject(light, "spot", [&](const Place& spot) -> absl::Status {
            FP_RETURN_IF_ERROR(CheckNumber(spot, "innerConeAngle", 0, 1.5707964));
            return CheckNumber(spot, "outerConeAngle", 0, 1.5707964);
          });
        });
      });
    });
  }

  absl::Status CheckNode(const Place& place) {
    std::optional<size_t> index;
    FP_RETURN_IF_ERROR(CheckString(place, "name"));
    FP_RETURN_IF_ERROR(ReadIndex(place, "mesh", Size("meshes"), "meshes", index));
    FP_RETURN_IF_ERROR(ReadIndex(place, "camera", Size("cameras"), "cameras", index));
    FP_RETURN_IF_ERROR(ReadIndex(place, "skin", Size("skins"), "skins", index));
    FP_RETURN_IF_ERROR(CheckIndices(place, "children", Size("nodes"), "nodes"));
    FP_RETURN_IF_ERROR(CheckNumbers(place, "matrix", 16));
    FP_RETURN_IF_ERROR(CheckNumbers(place, "translation", 3));
    FP_RETURN_IF_ERROR(CheckNumbers(place, "rotation", 4));
    FP_RETURN_IF_ERROR(CheckNumbers(place, "scale", 3));
    if (const Json* weights = place.Find("weights"); weights != nullptr) {
      FP_RETURN_IF_ERROR(CheckNumbers(place, "weights", weights->size(), -1e9, 1e9));
    }
    return WithObject(place, "extensions", [&](const Place& extensions) {
      FP_RETURN_IF_ERROR(
          WithObject(extensions, "EXT_mesh_gpu_instancing", [&](const Place& instancing) {
            return WithObject(instancing, "attributes",
                              [&](const Place& attributes) { return CheckInstances(attributes); });
          }));
      return WithObject(extensions, "KHR_lights_punctual", [&](const Place& p) -> absl::Status {
        std::optional<size_t> light;
        FP_RETURN_IF_ERROR(ReadIndex(p, "light", light_count_, "lights", light));
        return light ? absl::OkStatus() : p.Fail("has no 'light'");
      });
    });
  }

  absl::Status CheckInstances(const Place& attributes) {
    std::optional<uint64_t> instances;
    for (const auto& [key, value] : attributes.value().items()) {
      const Place place(attributes, key.c_str(), value);
      uint64_t count = 0;
      if (key == "TRANSLATION" || key == "SCALE") {
        FP_RETURN_IF_ERROR(CheckKind(place, {"VEC3"}, {5126}, {}, count));
      } else if (key == "ROTATION") {
        FP_RETURN_IF_ERROR(CheckKind(place, {"VEC4"}, {5126}, {5120, 5122}, count));
      } else {
        continue;
      }
      // Zeros that cost the file nothing would cost memory.
      if (!json_["accessors"][value.get<size_t>()].contains("bufferView")) {
        return place.Fail("accessor " + value.dump() + " has no bufferView");
      }
      if (instances && count != *instances) {
        return place.Fail("has " + std::to_string(count) + " elements where others have " +
                          std::to_string(*instances));
      }
      instances = count;
    }
    return absl::OkStatus();
  }

  absl::Status CheckSkin(const Place& place) {
    FP_RETURN_IF_ERROR(CheckString(place, "name"));
    const Json* joints = place.Find("joints");
    if (joints == nullptr) return place.Fail("has no 'joints'");
    FP_RETURN_IF_ERROR(CheckIndices(place, "joints", Size("nodes"), "nodes"));
    if (joints->empty()) return place.Member("joints").Fail("is empty");
    std::optional<size_t> skeleton;
    FP_RETURN_IF_ERROR(ReadIndex(place, "skeleton", Size("nodes"), "nodes", skeleton));
    const Json* matrices = place.Find("inverseBindMatrices");
    if (matrices == nullptr) return absl::OkStatus();
    const Place matrices_place(place, "inverseBindMatrices", *matrices);
    uint64_t count = 0;
    FP_RETURN_IF_ERROR(CheckKind(matrices_place, {"MAT4"}, {5126}, {}, count));
    if (count < joints->size()) {
      return matrices_place.Fail("has " + std::to_string(count) + " matrices for " +
                                 std::to_string(joints->size()) + " joints");
    }
    return absl::OkStatus();
  }

  absl::Status CheckAnimation(const Place& place) {
    struct Sampler {
      uint64_t keys = 0;
      bool is_cubic = false;
    };
    std::vector<Sampler> samplers;
    FP_RETURN_IF_ERROR(CheckString(place, "name"));
    FP_RETURN_IF_ERROR(ForEachObject(place, "samplers", [&](const Place& sampler) -> absl::Status {
      Sampler s;
      for (const char* key : {"input", "output"}) {
        if (sampler.Find(key) == nullptr) return sampler.Fail("has no '" + std::string(key) + "'");
        FP_RETURN_IF_ERROR(CheckIndexValue(sampler.Member(key), Size("accessors"), "accessors"));
      }
      FP_RETURN_IF_ERROR(CheckKind(sampler.Member("input"), {"SCALAR"}, {5126}, {}, s.keys));
      FP_RETURN_IF_ERROR(CheckString(sampler, "interpolation"));
      const std::string kind = sampler.value().value("interpolation", "LINEAR");
      if (kind != "LINEAR" && kind != "STEP" && kind != "CUBICSPLINE") {
        return sampler.Member("interpolation")
            .Fail("is '" + kind + "' instead of LINEAR, STEP or CUBICSPLINE");
      }
      if (s.keys == 0) return sampler.Member("input").Fail("has no keyframes");
      s.is_cubic = kind == "CUBICSPLINE";
      samplers.push_back(s);
      return absl::OkStatus();
    }));
    return ForEachObject(place, "channels", [&](const Place& channel) -> absl::Status {
      std::optional<size_t> index;
      FP_RETURN_IF_ERROR(ReadIndex(channel, "sampler", samplers.size(), "samplers", index));
      if (!index) return channel.Fail("has no 'sampler'");
      if (channel.Find("target") == nullptr) return channel.Fail("has no 'target'");
      const Sampler& sampler = samplers[*index];
      keyframes_ += sampler.keys;
      if (keyframes_ > kMaxKeyframes) {
        return channel.Fail("the animations have more than " + std::to_string(kMaxKeyframes) +
                            " keyframes");
      }
      return WithObject(channel, "target", [&](const Place& target) -> absl::Status {
        std::optional<size_t> node;
        FP_RETURN_IF_ERROR(ReadIndex(target, "node", Size("nodes"), "nodes", node));
        FP_RETURN_IF_ERROR(CheckString(target, "path"));
        const Json* path = target.Find("path");
        if (path == nullptr) return target.Fail("has no 'path'");
        if (!node) return absl::OkStatus();  // moves nothing
        return CheckOutput(place, target, path->get<std::string>(), *node, *index, sampler.keys,
                           sampler.is_cubic);
      });
    });
  }

  // What a sampler gives must be what its target takes.
  absl::Status CheckOutput(const Place& animation, const Place& target, const std::string& path,
                           size_t node_index, size_t sampler, uint64_t keys, bool is_cubic) {
    const Place samplers = animation.Member("samplers");
    const Place sampler_place(samplers, sampler, samplers.value()[sampler]);
    const Place output = sampler_place.Member("output");
    uint64_t count = 0, per_key = is_cubic ? 3 : 1;
    if (path == "translation" || path == "scale") {
      FP_RETURN_IF_ERROR(CheckKind(output, {"VEC3"}, {5126}, {}, count));
    } else if (path == "rotation") {
      FP_RETURN_IF_ERROR(CheckKind(output, {"VEC4"}, {5126}, {5120, 5121, 5122, 5123}, count));
    } else if (path == "weights") {
      const Json& node = json_["nodes"][node_index];
      const size_t targets = node.contains("mesh") ? morph_targets_[node["mesh"].get<size_t>()] : 0;
      if (targets == 0) {
        return target.Fail("weights of node " + std::to_string(node_index) +
                           ", whose mesh has no morph targets");
      }
      FP_RETURN_IF_ERROR(CheckKind(output, {"SCALAR"}, {5126}, {5120, 5121, 5122, 5123}, count));
      per_key *= targets;
    } else {
      return absl::OkStatus();  // of an extension
    }
    if (count / per_key != keys || count % per_key != 0) {
      return output.Fail("has " + std::to_string(count) + " elements for " + std::to_string(keys) +
                         " keyframes of " + std::to_string(per_key));
    }
    return absl::OkStatus();
  }

  absl::Status CheckSky(const Place& scene) {
    const Json* extras = scene.Find("extras");
    if (extras == nullptr || !extras->is_object()) return absl::OkStatus();
    return CheckNumbers(Place(scene, "extras", *extras), "farpoint_sky", 3, 0, 1e12);
  }

  struct View {
    uint64_t length, stride;
  };

  const AssetBundle& asset_;
  const GltfContainer& container_;
  const std::string& name_;
  const Json& json_;
  Place root_;
  std::vector<uint64_t> buffer_sizes_;
  std::vector<GltfBufferFile> buffer_files_;
  std::vector<View> views_;
  size_t light_count_ = 0;
  std::vector<size_t> morph_targets_;  // by mesh
  uint64_t keyframes_ = 0;
};

// The image behind root/textures[info.index], where all of that is well-formed.
void AddImageOf(const Json& root, const Json& holder, const char* key, std::set<size_t>& images) {
  const auto info = holder.find(key);
  if (info == holder.end() || !info->is_object()) return;
  const auto index = info->find("index");
  if (index == info->end() || !index->is_number_unsigned()) return;
  const size_t texture = index->get<size_t>();
  if (texture >= ArraySize(root, "textures")) return;
  const Json& object = root["textures"][texture];
  if (!object.is_object() || !object.contains("source")) return;
  if (object["source"].is_number_unsigned()) images.insert(object["source"].get<size_t>());
}

std::set<size_t> UsedImages(const Json& root, bool gloss) {
  std::set<size_t> images;
  for (size_t i = 0; i < ArraySize(root, "materials"); ++i) {
    const Json& material = root["materials"][i];
    if (!material.is_object()) continue;
    AddImageOf(root, material, "emissiveTexture", images);
    const auto pbr = material.find("pbrMetallicRoughness");
    if (pbr != material.end() && pbr->is_object()) {
      AddImageOf(root, *pbr, "baseColorTexture", images);
      if (gloss) AddImageOf(root, *pbr, "metallicRoughnessTexture", images);
    }
    if (gloss) AddImageOf(root, material, "normalTexture", images);
    const auto extensions = material.find("extensions");
    if (extensions == material.end() || !extensions->is_object()) continue;
    const auto glossiness = extensions->find("KHR_materials_pbrSpecularGlossiness");
    if (glossiness != extensions->end() && glossiness->is_object()) {
      AddImageOf(root, *glossiness, "diffuseTexture", images);
    }
  }
  return images;
}

template <typename T>
T ReadLittle(std::span<const std::byte> bytes, size_t at) {
  T value;
  std::memcpy(&value, bytes.data() + at, sizeof(T));
  return value;
}

}  // namespace

bool IsDataUri(std::string_view uri) { return uri.substr(0, 5) == "data:"; }

std::string DecodeUri(std::string_view uri) {
  const auto digit = [](char c) {
    if (c >= '0' && c <= '9') return c - '0';
    if (c >= 'a' && c <= 'f') return c - 'a' + 10;
    if (c >= 'A' && c <= 'F') return c - 'A' + 10;
    return -1;
  };
  std::string decoded;
  decoded.reserve(uri.size());
  for (size_t i = 0; i < uri.size(); ++i) {
    if (uri[i] == '%' && i + 2 < uri.size() && digit(uri[i + 1]) >= 0 && digit(uri[i + 2]) >= 0) {
      decoded += static_cast<char>(digit(uri[i + 1]) * 16 + digit(uri[i + 2]));
      i += 2;
    } else {
      decoded += uri[i];
    }
  }
  return decoded;
}

absl::StatusOr<GltfContainer> OpenGltfContainer(const std::string& name, const Blob& file) {
  const auto bytes = file.bytes();
  const auto fail = [&](const std::string& text) {
    return absl::DataLossError(name + ": " + text + "; copy or export the file again");
  };
  GltfContainer container;
  const bool magic = bytes.size() >= 4 && std::memcmp(bytes.data(), "glTF", 4) == 0;
  const bool named_glb = name.size() > 4 && (name.compare(name.size() - 4, 4, ".glb") == 0 ||
                                             name.compare(name.size() - 4, 4, ".GLB") == 0);
  if (!magic && named_glb) {
    return fail("byte 0: is no .glb of glTF 2.0: it has " + std::to_string(bytes.size()) +
                " bytes and does not start with 'glTF'");
  }
  if (!magic) {
    container.json = {reinterpret_cast<const char*>(bytes.data()), bytes.size()};
    // A byte order mark is not part of the JSON.
    if (container.json.substr(0, 3) == "\xef\xbb\xbf") container.json.remove_prefix(3);
    return container;
  }
  if (bytes.size() < 20) {
    return fail("byte " + std::to_string(bytes.size()) + ": ends inside of the header of a .glb, " +
                "which has 20 bytes");
  }
  const uint32_t version = ReadLittle<uint32_t>(bytes, 4);
  if (version != 2) {
    return absl::InvalidArgumentError(name + ": byte 4: is a .glb of version " +
                                      std::to_string(version) +
                                      "; only version 2 is read: export it as glTF 2.0");
  }
  const uint64_t length = ReadLittle<uint32_t>(bytes, 8);
  if (length > bytes.size()) {
    return fail("byte 8: should have " + std::to_string(length) + " bytes but has " +
                std::to_string(bytes.size()));
  }
  const uint64_t json_length = ReadLittle<uint32_t>(bytes, 12);
  if (ReadLittle<uint32_t>(bytes, 16) != 0x4E4F534A) return fail("byte 16: is no JSON chunk");
  if (json_length == 0 || json_length > length - std::min<uint64_t>(length, 20)) {
    return fail("byte 12: the JSON chunk of " + std::to_string(json_length) +
                " bytes is beyond the file");
  }
  container.binary = true;
  container.json = {reinterpret_cast<const char*>(bytes.data()) + 20, json_length};
  const uint64_t at = 20 + json_length;
  if (at == length) return container;
  if (at + 12 > length) return fail("byte " + std::to_string(at) + ": ends inside of a chunk");
  const uint64_t bin_length = ReadLittle<uint32_t>(bytes, at);
  if (ReadLittle<uint32_t>(bytes, at + 4) != 0x004E4942) {
    return fail("byte " + std::to_string(at + 4) + ": is no BIN chunk");
  }
  if (bin_length < 4 || bin_length % 4 != 0 || bin_length > length - at - 8) {
    return fail("byte " + std::to_string(at) + ": the BIN chunk of " + std::to_string(bin_length) +
                " bytes is beyond the file or no multiple of 4");
  }
  container.bin = bytes.subspan(at + 8, bin_length);
  return container;
}

absl::StatusOr<std::vector<GltfReference>> ListGltfReferences(const std::string& name,
                                                              const GltfContainer& container,
                                                              bool gloss) {
  FP_ASSIGN_OR_RETURN(const Json json, ParseJson(name, container.json));
  std::vector<GltfReference> references;
  const Place root(name, json);
  const std::set<size_t> used_images = UsedImages(json, gloss);
  for (const char* key : {"buffers", "images"}) {
    size_t index = 0;
    FP_RETURN_IF_ERROR(ForEachObject(root, key, [&](const Place& place) -> absl::Status {
      const bool used = key[0] == 'b' || used_images.count(index) != 0;
      ++index;
      const Json* uri = place.Find("uri");
      if (uri == nullptr || !used) return absl::OkStatus();
      const Place uri_place(place, "uri", *uri);
      FP_ASSIGN_OR_RETURN(std::string external, ReadExternalUri(uri_place));
      if (!external.empty()) references.push_back({std::move(external), uri_place.Path()});
      return absl::OkStatus();
    }));
  }
  return references;
}

absl::StatusOr<std::vector<GltfBufferFile>> CheckGltf(const AssetBundle& asset,
                                                      const GltfContainer& container) {
  FP_ASSIGN_OR_RETURN(const Json json, ParseJson(asset.root, container.json));
  Checker checker(asset, container, json);
  FP_RETURN_IF_ERROR(checker.Run());
  return checker.TakeBufferFiles();
}

}  // namespace farpoint
