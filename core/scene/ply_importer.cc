#include "core/scene/ply_importer.h"

#include <algorithm>
#include <array>
#include <bit>
#include <cmath>
#include <cstring>
#include <limits>
#include <optional>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "core/math/elementary.h"
#include "core/scene/polygon.h"
#include "core/scene/text_lines.h"

namespace farpoint {

namespace {

constexpr size_t kMaxHeaderBytes = size_t{1} << 20;
constexpr size_t kMaxProperties = 4096;
constexpr const char* kCorrect = "; correct the file or export it again";

enum class Format { kAscii, kLittle, kBig };
enum class Type { kInt8, kUint8, kInt16, kUint16, kInt32, kUint32, kFloat32, kFloat64 };

struct TypeInfo {
  const char *name, *other_name;
  Type type;
  size_t bytes;
};
constexpr TypeInfo kTypes[] = {
    {"char", "int8", Type::kInt8, 1},        {"uchar", "uint8", Type::kUint8, 1},
    {"short", "int16", Type::kInt16, 2},     {"ushort", "uint16", Type::kUint16, 2},
    {"int", "int32", Type::kInt32, 4},       {"uint", "uint32", Type::kUint32, 4},
    {"float", "float32", Type::kFloat32, 4}, {"double", "float64", Type::kFloat64, 8}};

const TypeInfo* FindType(std::string_view name) {
  for (const TypeInfo& info : kTypes) {
    if (name == info.name || name == info.other_name) return &info;
  }
  return nullptr;
}

bool IsInteger(Type type) { return type != Type::kFloat32 && type != Type::kFloat64; }

struct Property {
  std::string name;
  const TypeInfo* type = nullptr;
  const TypeInfo* count_type = nullptr;  // of a list; else nullptr
};

struct Element {
  std::string name;
  uint64_t count = 0;
  std::vector<Property> properties;
};

struct Header {
  Format format = Format::kAscii;
  std::vector<Element> elements;
  std::string texture;  // "comment TextureFile NAME"
  size_t bytes = 0, lines = 0;
};

// What a property of a vertex means here.
enum Slot { kX, kY, kZ, kNx, kNy, kNz, kRed, kGreen, kBlue, kSlots };
std::optional<Slot> SlotOf(std::string_view name) {
  constexpr std::pair<const char*, Slot> kNames[] = {{"x", kX},
                                                     {"y", kY},
                                                     {"z", kZ},
                                                     {"nx", kNx},
                                                     {"ny", kNy},
                                                     {"nz", kNz},
                                                     {"red", kRed},
                                                     {"green", kGreen},
                                                     {"blue", kBlue},
                                                     {"r", kRed},
                                                     {"g", kGreen},
                                                     {"b", kBlue},
                                                     {"diffuse_red", kRed},
                                                     {"diffuse_green", kGreen},
                                                     {"diffuse_blue", kBlue}};
  for (const auto& [known, slot] : kNames) {
    if (name == known) return slot;
  }
  return std::nullopt;
}

// What a value of such a type as a colour stands for: linear. Integers are sRGB over their range.
float LinearColor(double value, Type type) {
  if (type == Type::kUint8) return static_cast<float>(SrgbToLinear(value / 255));
  if (type == Type::kUint16) return static_cast<float>(SrgbToLinear(value / 65535));
  return value > 0 ? static_cast<float>(std::min(value, 1.0)) : 0.0f;
}

class PlyReader {
 public:
  PlyReader(const AssetBundle& asset, const ImportOptions& options)
      : asset_(asset), options_(options) {}

  absl::StatusOr<ImportedScene> Run() {
    FP_ASSIGN_OR_RETURN(file_, asset_.Find(asset_.root));
    text_ = {reinterpret_cast<const char*>(file_.bytes().data()), file_.size()};
    FP_RETURN_IF_ERROR(ReadHeader());
    at_ = header_.bytes;
    for (const Element& element : header_.elements) {
      FP_RETURN_IF_ERROR(CheckCount(element));
      if (element.name == "vertex") {
        FP_RETURN_IF_ERROR(ReadVertices(element));
      } else if (element.name == "face" || element.name == "tristrips") {
        FP_RETURN_IF_ERROR(ReadFaces(element));
      } else {
        ignored_ += (ignored_.empty() ? "" : ", ") + element.name;
        FP_RETURN_IF_ERROR(ReadRows(
            element, [](size_t, double) {},
            [](size_t, std::span<const double>) { return absl::OkStatus(); },
            [](uint64_t) { return absl::OkStatus(); }));
      }
    }
    if (!has_vertices_) return FailHeader(1, "has no 'element vertex'");
    FP_RETURN_IF_ERROR(BuildMesh());
    return std::move(imported_);
  }

 private:
  void Note(std::string text) { imported_.notes.push_back(std::move(text)); }
  absl::Status FailAt(const std::string& place, const std::string& text) const {
    return absl::InvalidArgumentError(asset_.root + ": " + place + ": " + text + kCorrect);
  }
  absl::Status FailHeader(size_t line, const std::string& text) const {
    return FailAt("line " + std::to_string(line), text);
  }
  // At the present place of the data.
  absl::Status Fail(const Element& element, uint64_t row, const std::string& text) const {
    std::string place = element.name + " " + std::to_string(row) + ", ";
    if (header_.format == Format::kAscii) {
      const auto lines = std::count(text_.begin() + static_cast<ptrdiff_t>(header_.bytes),
                                    text_.begin() + static_cast<ptrdiff_t>(token_at_), '\n');
      place += "line " + std::to_string(header_.lines + 1 + static_cast<size_t>(lines));
    } else {
      place += "byte " + std::to_string(at_);
    }
    return FailAt(place, text);
  }

  // --- Header ---

  absl::Status ReadHeader() {
    const std::string_view head = text_.substr(0, kMaxHeaderBytes);
    size_t at = 0, line_number = 0;
    bool has_format = false;
    size_t properties = 0;
    for (;;) {
      const size_t end = head.find('\n', at);
      if (end == std::string_view::npos) {
        return FailHeader(line_number + 1, line_number == 0 ? "does not start with 'ply'"
                                                            : "the header has no 'end_header'");
      }
      std::string_view rest = head.substr(at, end - at);
      if (!rest.empty() && rest.back() == '\r') rest.remove_suffix(1);
      at = end + 1;
      ++line_number;
      const std::string_view whole = Trim(rest);
      const std::string_view key = NextWord(rest);
      if (line_number == 1) {
        if (whole != "ply") return FailHeader(1, "does not start with 'ply'");
        continue;
      }
      if (key == "end_header") break;
      if (key.empty() || key == "obj_info") continue;
      if (key == "comment") {
        if (NextWord(rest) == "TextureFile") header_.texture = std::string(Trim(rest));
        continue;
      }
      if (key == "format") {
        const std::string_view format = NextWord(rest), version = NextWord(rest);
        has_format = true;
        if (format == "ascii") {
          header_.format = Format::kAscii;
        } else if (format == "binary_little_endian") {
          header_.format = Format::kLittle;
        } else if (format == "binary_big_endian") {
          header_.format = Format::kBig;
        } else {
          return FailHeader(line_number, "the format is " + Quoted(format) +
                                             " instead of ascii, binary_little_endian or "
                                             "binary_big_endian");
        }
        if (version != "1.0") {
          return FailHeader(line_number, "the version is " + Quoted(version) + " instead of 1.0");
        }
        continue;
      }
      if (key == "element") {
        Element element;
        element.name = Printable(NextWord(rest));
        const std::string_view word = NextWord(rest);
        const auto count = ParseInteger(word);
        if (element.name.empty() || !count || *count < 0) {
          return FailHeader(line_number, "expected 'element NAME COUNT', found " + Quoted(whole));
        }
        element.count = static_cast<uint64_t>(*count);
        header_.elements.push_back(std::move(element));
      } else if (key == "property") {
        if (header_.elements.empty()) {
          return FailHeader(line_number, "a property before the first element");
        }
        if (++properties > kMaxProperties) {
          return FailHeader(line_number,
                            "more than " + std::to_string(kMaxProperties) + " properties");
        }
        Property property;
        std::string_view type = NextWord(rest);
        if (type == "list") {
          const std::string_view count_type = NextWord(rest);
          property.count_type = FindType(count_type);
          if (property.count_type == nullptr || !IsInteger(property.count_type->type)) {
            return FailHeader(line_number, Quoted(count_type) + " is no type of integers");
          }
          type = NextWord(rest);
        }
        property.type = FindType(type);
        if (property.type == nullptr) {
          return FailHeader(line_number, Quoted(type) + " is no type of numbers");
        }
        property.name = Printable(NextWord(rest));
        header_.elements.back().properties.push_back(std::move(property));
      } else {
        return FailHeader(line_number, Quoted(key) +
                                           " is no statement of a PLY header (format, element, "
                                           "property, comment, obj_info, end_header)");
      }
    }
    if (!has_format) return FailHeader(line_number, "the header has no 'format'");
    header_.bytes = at;
    header_.lines = line_number;
    return absl::OkStatus();
  }

  // Bytes that a row takes at least: a number of an ascii file has a digit and a separator (but for
  // the last of all).
  uint64_t LeastRowBytes(const Element& element) const {
    uint64_t bytes = 0;
    for (const Property& p : element.properties) {
      if (header_.format == Format::kAscii) {
        bytes += 2;
      } else {
        bytes += p.count_type != nullptr ? p.count_type->bytes : p.type->bytes;
      }
    }
    return bytes;
  }

  absl::Status CheckCount(const Element& element) const {
    const uint64_t row = LeastRowBytes(element), left = text_.size() - at_;
    if (row == 0 || element.count <= (left + 1) / row) return absl::OkStatus();
    return FailAt("header", std::to_string(element.count) + " elements '" + element.name +
                                "' of at least " + std::to_string(row) + " bytes are beyond the " +
                                std::to_string(left) + " bytes that are left of the file");
  }

  // --- Data ---

  // The next number of the data; nothing at its end or where it is none.
  std::optional<double> ReadValue(const TypeInfo& type) {
    if (header_.format == Format::kAscii) {
      while (at_ < text_.size() && static_cast<unsigned char>(text_[at_]) <= ' ') ++at_;
      token_at_ = at_;
      while (at_ < text_.size() && static_cast<unsigned char>(text_[at_]) > ' ') ++at_;
      return ParseNumber(text_.substr(token_at_, at_ - token_at_));
    }
    if (text_.size() - at_ < type.bytes) return std::nullopt;
    uint64_t bits = 0;
    for (size_t i = 0; i < type.bytes; ++i) {
      const size_t from = header_.format == Format::kLittle ? i : type.bytes - 1 - i;
      bits |= uint64_t{static_cast<unsigned char>(text_[at_ + from])} << (8 * i);
    }
    at_ += type.bytes;
    switch (type.type) {
      case Type::kInt8:
        return static_cast<int8_t>(bits);
      case Type::kUint8:
        return static_cast<uint8_t>(bits);
      case Type::kInt16:
        return static_cast<int16_t>(bits);
      case Type::kUint16:
        return static_cast<uint16_t>(bits);
      case Type::kInt32:
        return static_cast<int32_t>(bits);
      case Type::kUint32:
        return static_cast<uint32_t>(bits);
      case Type::kFloat32:
        return std::bit_cast<float>(static_cast<uint32_t>(bits));
      case Type::kFloat64:
        return std::bit_cast<double>(bits);
    }
    return std::nullopt;
  }

  absl::Status FailValue(const Element& element, uint64_t row, const Property& property) const {
    const bool ended = header_.format != Format::kAscii || token_at_ >= text_.size();
    return Fail(element, row,
                ended ? "the file ends before '" + property.name + "'"
                      : Quoted(text_.substr(token_at_, at_ - token_at_)) + " for '" +
                            property.name + "' is no number");
  }

  // Calls scalar(property, value) and list(property, values) for the properties of each row, then
  // end(row).
  template <typename OnScalar, typename OnList, typename OnEnd>
  absl::Status ReadRows(const Element& element, const OnScalar& scalar, const OnList& list,
                        const OnEnd& end) {
    if (element.properties.empty()) return absl::OkStatus();
    for (uint64_t row = 0; row < element.count; ++row) {
      for (size_t p = 0; p < element.properties.size(); ++p) {
        const Property& property = element.properties[p];
        const auto value =
            ReadValue(property.count_type != nullptr ? *property.count_type : *property.type);
        if (!value) return FailValue(element, row, property);
        if (property.count_type == nullptr) {
          scalar(p, *value);
          continue;
        }
        const uint64_t least = header_.format == Format::kAscii ? 1 : property.type->bytes;
        if (!(*value >= 0) || *value != std::floor(*value) ||
            !(*value <= static_cast<double>((text_.size() - at_) / least))) {
          return Fail(element, row,
                      "the list '" + property.name +
                          "' has a length that is none, or "
                          "beyond the end of the file");
        }
        const auto count = static_cast<uint64_t>(*value);
        values_.clear();
        for (uint64_t i = 0; i < count; ++i) {
          const auto entry = ReadValue(*property.type);
          if (!entry) return FailValue(element, row, property);
          values_.push_back(*entry);
        }
        row_ = row;
        FP_RETURN_IF_ERROR(list(p, std::span<const double>(values_)));
      }
      FP_RETURN_IF_ERROR(end(row));
    }
    return absl::OkStatus();
  }

  absl::Status ReadVertices(const Element& element) {
    if (has_vertices_) return FailAt("header", "has 'element vertex' twice");
    has_vertices_ = true;
    if (element.count >= MeshCorner::kNone) {
      return FailAt("header", "has more than 2^32 vertices");
    }
    std::vector<std::optional<Slot>> slots;
    std::array<bool, kSlots> has{};
    std::array<Type, kSlots> types{};
    for (const Property& property : element.properties) {
      slots.push_back(property.count_type != nullptr ? std::nullopt : SlotOf(property.name));
      if (slots.back()) {
        has[*slots.back()] = true;
        types[*slots.back()] = property.type->type;
      }
    }
    if (!(has[kX] && has[kY] && has[kZ])) {
      return FailAt("header", "'element vertex' has no properties x, y and z");
    }
    const bool has_normals = has[kNx] && has[kNy] && has[kNz];
    const bool has_colors = has[kRed] && has[kGreen] && has[kBlue];
    std::array<double, kSlots> v{};
    positions_.reserve(element.count);
    return ReadRows(
        element,
        [&](size_t p, double value) {
          if (slots[p]) v[*slots[p]] = value;
        },
        [](size_t, std::span<const double>) { return absl::OkStatus(); },
        [&](uint64_t row) -> absl::Status {
          const Vec3d p(v[kX], v[kY], v[kZ]);
          if (!IsFinite(p) || MaxAbs(p) > std::numeric_limits<float>::max()) {
            return Fail(element, row,
                        "the position is not finite or beyond the range of single precision");
          }
          positions_.push_back(p);
          bounds_.Extend(p);
          if (has_normals) {
            normals_.push_back(Vec3f(NormalizeOr(Vec3d(v[kNx], v[kNy], v[kNz]), Vec3d())));
          }
          if (has_colors) {
            colors_.push_back({LinearColor(v[kRed], types[kRed]),
                               LinearColor(v[kGreen], types[kGreen]),
                               LinearColor(v[kBlue], types[kBlue])});
          }
          return absl::OkStatus();
        });
  }

  absl::Status AddTriangles(uint64_t count, const Element& element) {
    triangle_count_ += count;
    if (triangle_count_ <= options_.max_triangles) return absl::OkStatus();
    return absl::ResourceExhaustedError(asset_.root + ": " + element.name + " " +
                                        std::to_string(row_) + ": the scene has more than " +
                                        std::to_string(options_.max_triangles) +
                                        " triangles; simplify it or raise the limit");
  }

  // Faces may stand before the vertices, so that their indices are checked at the end.
  absl::Status ReadFaces(const Element& element) {
    std::optional<size_t> indices;
    for (size_t p = 0; p < element.properties.size(); ++p) {
      const Property& property = element.properties[p];
      if (property.name != "vertex_indices" && property.name != "vertex_index") continue;
      if (property.count_type == nullptr || !IsInteger(property.type->type)) {
        return FailAt("header", "'" + property.name + "' is no list of integers");
      }
      indices = p;
    }
    if (!indices && element.count > 0) {
      return FailAt("header", "'element " + element.name + "' has no list 'vertex_indices'");
    }
    const bool strips = element.name == "tristrips";
    return ReadRows(
        element, [](size_t, double) {},
        [&](size_t p, std::span<const double> values) -> absl::Status {
          if (p != *indices) return absl::OkStatus();
          return strips ? AddStrips(element, values) : AddFace(element, values);
        },
        [](uint64_t) { return absl::OkStatus(); });
  }

  absl::Status ToIndex(const Element& element, double value, uint32_t& out) const {
    if (!(value >= 0) || !(value < MeshCorner::kNone) || value != std::floor(value)) {
      return Fail(element, row_, "a vertex index is negative or no integer");
    }
    out = static_cast<uint32_t>(value);
    return absl::OkStatus();
  }

  absl::Status AddFace(const Element& element, std::span<const double> values) {
    if (values.size() < 3) {
      ++skipped_faces_;
      return absl::OkStatus();
    }
    if (values.size() > kMaxPolygonCorners) {
      return Fail(element, row_,
                  "the face has " + std::to_string(values.size()) + " corners, more than " +
                      std::to_string(kMaxPolygonCorners) + ": triangulate it");
    }
    FP_RETURN_IF_ERROR(AddTriangles(values.size() - 2, element));
    for (const double value : values) {
      uint32_t index = 0;
      FP_RETURN_IF_ERROR(ToIndex(element, value, index));
      corners_.push_back(index);
    }
    face_ends_.push_back(corners_.size());
    return absl::OkStatus();
  }

  // Strips that a -1 ends; the winding alternates along each.
  absl::Status AddStrips(const Element& element, std::span<const double> values) {
    size_t begin = 0;
    for (size_t i = 0; i <= values.size(); ++i) {
      if (i < values.size() && values[i] != -1) continue;
      for (size_t k = begin; k + 2 < i; ++k) {
        FP_RETURN_IF_ERROR(AddTriangles(1, element));
        for (const size_t c : {k, k + 1 + (k - begin) % 2, k + 2 - (k - begin) % 2}) {
          uint32_t index = 0;
          FP_RETURN_IF_ERROR(ToIndex(element, values[c], index));
          corners_.push_back(index);
        }
        face_ends_.push_back(corners_.size());
      }
      begin = i + 1;
    }
    return absl::OkStatus();
  }

  // --- Mesh ---

  absl::Status BuildMesh() {
    Mesh mesh;
    mesh.name = asset_.root;
    mesh.triangles.reserve(triangle_count_);
    size_t begin = 0, crossed = 0;
    std::vector<Vec3d> polygon;
    std::vector<std::array<uint32_t, 3>> cut;
    for (size_t f = 0; f < face_ends_.size(); ++f) {
      polygon.clear();
      cut.clear();
      for (size_t c = begin; c < face_ends_[f]; ++c) {
        if (corners_[c] >= positions_.size()) {
          return FailAt("face " + std::to_string(f),
                        "vertex index " + std::to_string(corners_[c]) + " is beyond the " +
                            std::to_string(positions_.size()) + " vertices");
        }
        polygon.push_back(positions_[corners_[c]]);
      }
      if (!TriangulatePolygon(polygon, cut)) ++crossed;
      for (const auto& t : cut) {
        mesh.triangles.push_back(
            {corners_[begin + t[0]], corners_[begin + t[1]], corners_[begin + t[2]]});
      }
      begin = face_ends_[f];
    }
    const Vec3d offset = OffsetFor(bounds_);
    mesh.positions.reserve(positions_.size());
    for (const Vec3d& p : positions_) mesh.positions.push_back(Vec3f(p - offset));
    mesh.normals = std::move(normals_);
    Scene& scene = imported_.scene;
    scene.name = asset_.root;
    if (!colors_.empty() && !mesh.triangles.empty()) {
      mesh.material = AddColorMaterial(MeanColor(mesh, colors_), scene);
      Note("colours at the vertices: shown in their mean");
    }
    if (mesh.triangles.empty()) {
      Note(positions_.empty()
               ? "the scene has no triangles"
               : "the scene has no triangles: its " + std::to_string(positions_.size()) +
                     " points are not shown; mesh them first");
    } else {
      Instance instance;
      instance.name = mesh.name;
      instance.world_from_mesh.translation = offset;
      scene.instances.push_back(std::move(instance));
      scene.meshes.push_back(std::move(mesh));
    }
    if (skipped_faces_ > 0) {
      Note(std::to_string(skipped_faces_) + " faces of fewer than 3 corners skipped");
    }
    if (crossed > 0) {
      Note(std::to_string(crossed) + " faces that cross themselves or have no area");
    }
    if (!header_.texture.empty()) {
      Note("the texture " + Quoted(header_.texture) +
           " is ignored: PLY is read as plain geometry; convert the scene to glTF or OBJ");
    }
    if (!ignored_.empty()) Note("elements ignored: " + ignored_);
    return absl::OkStatus();
  }

  const AssetBundle& asset_;
  const ImportOptions& options_;
  ImportedScene imported_;
  Blob file_;
  std::string_view text_;
  Header header_;
  size_t at_ = 0, token_at_ = 0;
  uint64_t row_ = 0;
  std::vector<double> values_;

  bool has_vertices_ = false;
  std::vector<Vec3d> positions_;
  Box3d bounds_;
  std::vector<Vec3f> normals_;
  std::vector<Rgb> colors_;
  std::vector<uint32_t> corners_;
  std::vector<uint64_t> face_ends_;
  uint64_t triangle_count_ = 0, skipped_faces_ = 0;
  std::string ignored_;
};

}  // namespace

absl::StatusOr<ImportedScene> ImportPly(const AssetBundle& asset, const ImportOptions& options) {
  return PlyReader(asset, options).Run();
}

}  // namespace farpoint
