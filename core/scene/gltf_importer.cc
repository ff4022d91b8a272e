#include "core/scene/gltf_importer.h"

#include <tiny_gltf.h>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>
#include <map>
#include <optional>
#include <set>
#include <tuple>
#include <utility>

#include "core/math/elementary.h"
#include "core/scene/gltf_accessor.h"
#include "core/scene/gltf_animation.h"
#include "core/scene/gltf_check.h"
#include "core/scene/gltf_deform.h"
#include "core/scene/polygon.h"

namespace farpoint {

namespace {

// Luminous efficacy by which glTF's exporters turn watts into lumens (KHR_lights_punctual).
constexpr double kLumensPerWatt = 683.0;

constexpr const char* kSpecularGlossiness = "KHR_materials_pbrSpecularGlossiness";

// Extensions that are read, that only concern what is not shown, or nothing that is rendered.
const char* const kHarmlessExtensions[] = {"KHR_lights_punctual",
                                           "KHR_materials_emissive_strength",
                                           "KHR_texture_transform",
                                           "KHR_mesh_quantization",
                                           "EXT_mesh_gpu_instancing",
                                           "KHR_materials_pbrSpecularGlossiness",
                                           "KHR_materials_ior",
                                           "KHR_materials_specular",
                                           "KHR_materials_anisotropy",
                                           "KHR_xmp_json_ld",
                                           "KHR_xmp",
                                           "FB_ngon_encoding"};

std::string Indexed(const char* array, size_t index) {
  return std::string("/") + array + "/" + std::to_string(index);
}

std::string NameOr(const std::string& name, const char* array, size_t index) {
  return name.empty() ? std::string(array) + " " + std::to_string(index) : name;
}

// --- What tinygltf calls ---

// The buffers' files under the names by which tinygltf asks for them.
struct BufferFiles {
  struct File {
    std::span<const std::byte> bytes;  // exactly byteLength of them: tinygltf compares
    std::string uri;
  };
  std::map<std::string, File> by_name;
};

// tinygltf decodes percent signs as we do, and "+" as a blank.
std::string TinygltfName(const std::string& uri) {
  std::string plus_decoded = uri;
  std::replace(plus_decoded.begin(), plus_decoded.end(), '+', ' ');
  return DecodeUri(plus_decoded);
}

bool FileExists(const std::string& name, void* user) {
  return static_cast<const BufferFiles*>(user)->by_name.count(name) != 0;
}

std::string ExpandFilePath(const std::string& name, void*) { return name; }

bool ReadWholeFile(std::vector<unsigned char>* out, std::string* error, const std::string& name,
                   void* user) {
  const auto& files = static_cast<const BufferFiles*>(user)->by_name;
  const auto it = files.find(name);
  if (it == files.end()) {
    *error = "'" + name + "' is not part of the asset";
    return false;
  }
  const auto* data = reinterpret_cast<const unsigned char*>(it->second.bytes.data());
  out->assign(data, data + it->second.bytes.size());
  return true;
}

// tinygltf 2.9 and later ask for it.
[[maybe_unused]] bool FileSize(size_t* bytes, std::string* error, const std::string& name,
                               void* user) {
  const auto& files = static_cast<const BufferFiles*>(user)->by_name;
  const auto it = files.find(name);
  if (it == files.end()) {
    *error = "'" + name + "' is not part of the asset";
    return false;
  }
  *bytes = it->second.bytes.size();
  return true;
}

bool WriteWholeFile(std::string* error, const std::string&, const std::vector<unsigned char>&,
                    void*) {
  *error = "nothing is written while a scene is read";
  return false;
}

template <typename Callbacks>  // tinygltf::FsCallbacks, whose fields depend on its version
Callbacks CallbacksFor(BufferFiles& files) {
  Callbacks callbacks = {};
  callbacks.FileExists = FileExists;
  callbacks.ExpandFilePath = ExpandFilePath;
  callbacks.ReadWholeFile = ReadWholeFile;
  callbacks.WriteWholeFile = WriteWholeFile;
  if constexpr (requires { callbacks.GetFileSizeInBytes; }) {
    callbacks.GetFileSizeInBytes = FileSize;
  }
  callbacks.user_data = &files;
  return callbacks;
}

// Keeps the encoded bytes; what is used is decoded when the scene is prepared.
bool KeepEncodedImage(tinygltf::Image* image, const int, std::string*, std::string*, int, int,
                      const unsigned char* bytes, int size, void*) {
  image->image.assign(bytes, bytes + size);
  image->as_is = true;
  return true;
}

// --- Small conversions ---

Vec3d ToVec3d(const std::vector<double>& v) { return {v[0], v[1], v[2]}; }

Affine LocalTransform(const tinygltf::Node& node) {
  Affine m;
  if (node.matrix.size() == 16) {
    for (int c = 0; c < 3; ++c) {
      m.column[c] = {node.matrix[4 * c], node.matrix[4 * c + 1], node.matrix[4 * c + 2]};
    }
    m.translation = {node.matrix[12], node.matrix[13], node.matrix[14]};
    return m;
  }
  if (node.rotation.size() == 4) {
    m = RotationOf({node.rotation[0], node.rotation[1], node.rotation[2], node.rotation[3]});
  }
  if (node.scale.size() == 3) {
    for (int c = 0; c < 3; ++c) m.column[c] *= node.scale[static_cast<size_t>(c)];
  }
  if (node.translation.size() == 3) m.translation = ToVec3d(node.translation);
  return m;
}

bool IsFinite(const Affine& m) {
  return IsFinite(m.column[0]) && IsFinite(m.column[1]) && IsFinite(m.column[2]) &&
         IsFinite(m.translation);
}

WrapMode ToWrapMode(int wrap) {
  if (wrap == TINYGLTF_TEXTURE_WRAP_CLAMP_TO_EDGE) return WrapMode::kClampToEdge;
  if (wrap == TINYGLTF_TEXTURE_WRAP_MIRRORED_REPEAT) return WrapMode::kMirroredRepeat;
  return WrapMode::kRepeat;
}

const tinygltf::Value* FindExtension(const tinygltf::ExtensionMap& extensions, const char* name) {
  const auto it = extensions.find(name);
  return it == extensions.end() || !it->second.IsObject() ? nullptr : &it->second;
}

double NumberOr(const tinygltf::Value& object, const char* key, double fallback) {
  if (!object.Has(key)) return fallback;
  const tinygltf::Value& value = object.Get(key);
  return value.IsNumber() ? value.GetNumberAsDouble() : fallback;
}

// A texture info within an extension, which tinygltf leaves as it is.
struct TextureInfo {
  int index = -1;
  int uv_set = 0;
  const tinygltf::Value* transform = nullptr;  // KHR_texture_transform
};

TextureInfo InfoOf(const tinygltf::TextureInfo& info) {
  return {info.index, info.texCoord, FindExtension(info.extensions, "KHR_texture_transform")};
}

// Of an interface between air and what refracts by `ior`, seen straight on (KHR_materials_ior; its
// 0 stands for infinity).
float ReflectanceOf(double ior) {
  constexpr double kMost = 0.99;
  if (!(ior >= 1)) return ior == 0 ? static_cast<float>(kMost) : 0.0f;
  const double root = (ior - 1) / (ior + 1);
  return static_cast<float>(std::min(root * root, kMost));
}

TextureInfo InfoOf(const tinygltf::Value& holder, const char* key) {
  TextureInfo info;
  if (!holder.Has(key) || !holder.Get(key).IsObject()) return info;
  const tinygltf::Value& object = holder.Get(key);
  info.index = static_cast<int>(NumberOr(object, "index", -1));
  info.uv_set = static_cast<int>(NumberOr(object, "texCoord", 0));
  if (object.Has("extensions") && object.Get("extensions").IsObject()) {
    const tinygltf::Value& extensions = object.Get("extensions");
    if (extensions.Has("KHR_texture_transform")) {
      const tinygltf::Value& transform = extensions.Get("KHR_texture_transform");
      if (transform.IsObject()) info.transform = &transform;
    }
  }
  return info;
}

std::string Counted(size_t count, const char* what) {
  return std::to_string(count) + " " + what + (count == 1 ? "" : "s");
}

class Importer {
 public:
  Importer(const AssetBundle& asset, const ImportOptions& options)
      : asset_(asset), options_(options) {}

  absl::StatusOr<ImportedScene> Run() {
    FP_RETURN_IF_ERROR(Load());
    FP_ASSIGN_OR_RETURN(imported_.animation, AnimationRangeOf(model_, asset_.root));
    if (options_.time_s) {
      if (!std::isfinite(*options_.time_s)) {
        return absl::InvalidArgumentError(asset_.root +
                                          ": /animations: the time asked for is not finite; give "
                                          "it in seconds");
      }
      FP_RETURN_IF_ERROR(ApplyAnimations(*options_.time_s, asset_.root, model_));
    }
    scene_.name = asset_.root;
    NoteExtensions();
    FP_RETURN_IF_ERROR(ImportTextures());
    ImportMaterials();
    FP_RETURN_IF_ERROR(ImportMeshes());
    FP_RETURN_IF_ERROR(ImportNodes());
    FP_RETURN_IF_ERROR(CheckTriangleCount());
    ImportSky();
    NoteCounts();
    imported_.scene = std::move(scene_);
    return std::move(imported_);
  }

  absl::StatusOr<std::optional<TimeRange>> FindAnimation() {
    FP_ASSIGN_OR_RETURN(const Blob file, asset_.Find(asset_.root));
    FP_ASSIGN_OR_RETURN(const GltfContainer container, OpenGltfContainer(asset_.root, file));
    if (container.json.find("\"animations\"") == std::string_view::npos) {
      return std::optional<TimeRange>();
    }
    FP_RETURN_IF_ERROR(Load());
    return AnimationRangeOf(model_, asset_.root);
  }

 private:
  absl::Status Fail(const std::string& place, const std::string& text) const {
    return absl::InvalidArgumentError(asset_.root + ": " + place + ": " + text);
  }
  void Note(std::string text) { imported_.notes.push_back(std::move(text)); }

  absl::Status Load() {
    FP_ASSIGN_OR_RETURN(const Blob file, asset_.Find(asset_.root));
    FP_ASSIGN_OR_RETURN(const GltfContainer container, OpenGltfContainer(asset_.root, file));
    FP_ASSIGN_OR_RETURN(const auto buffers, CheckGltf(asset_, container));
    BufferFiles files;
    FP_RETURN_IF_ERROR(OfferBuffers(buffers, files));
    std::string error, warning;
    bool loaded = false;
    try {
      tinygltf::TinyGLTF loader;
      loader.SetFsCallbacks(CallbacksFor<tinygltf::FsCallbacks>(files));
      loader.SetImageLoader(KeepEncodedImage, nullptr);
      const auto* bytes = reinterpret_cast<const unsigned char*>(file.bytes().data());
      if (container.binary) {
        loaded = loader.LoadBinaryFromMemory(&model_, &error, &warning, bytes,
                                             static_cast<unsigned>(file.size()), "");
      } else {
        if (container.json.size() > std::numeric_limits<unsigned>::max()) {
          return Fail("/", "has more than 4 GiB of JSON; keep the buffers in files of their own");
        }
        loaded = loader.LoadASCIIFromString(&model_, &error, &warning, container.json.data(),
                                            static_cast<unsigned>(container.json.size()), "");
      }
    } catch (const std::exception& e) {
      error = e.what();
      loaded = false;
    }
    if (loaded) return absl::OkStatus();
    while (!error.empty() && error.back() == '\n') error.pop_back();
    return Fail("/", error.substr(0, 512) + "; correct the file or export it again");
  }

  absl::Status OfferBuffers(const std::vector<GltfBufferFile>& buffers, BufferFiles& files) const {
    for (const GltfBufferFile& buffer : buffers) {
      FP_ASSIGN_OR_RETURN(const Blob blob, asset_.Find(DecodeUri(buffer.uri)));
      const auto bytes = blob.bytes().subspan(0, buffer.byte_length);
      const std::string name = TinygltfName(buffer.uri);
      const auto [it, is_new] =
          files.by_name.try_emplace(name, BufferFiles::File{bytes, buffer.uri});
      if (is_new) continue;
      if (it->second.uri != buffer.uri) {
        return Fail("/buffers", "'" + it->second.uri + "' and '" + buffer.uri +
                                    "' differ only by a plus sign for a blank; rename one");
      }
      if (it->second.bytes.size() != bytes.size()) {
        return Fail("/buffers",
                    "two buffers give '" + buffer.uri + "' different lengths; make them one");
      }
    }
    return absl::OkStatus();
  }

  void NoteExtensions() {
    for (const std::string& name : model_.extensionsUsed) {
      if (name == "KHR_materials_unlit") {
        Note(
            "the extension 'KHR_materials_unlit' is ignored: its materials are lit, in their base "
            "colour");
        continue;
      }
      if (name == "KHR_materials_variants") {
        Note("the extension 'KHR_materials_variants' is ignored: the default materials are shown");
        continue;
      }
      bool harmless = false;
      for (const char* known : kHarmlessExtensions) harmless |= name == known;
      if (!harmless) Note("the extension '" + name + "' is ignored, which may change the look");
    }
  }

  // One Texture for each glTF texture, so that indices stay; images are shared.
  absl::Status ImportTextures() {
    std::set<int> used;
    for (const auto& material : model_.materials) {
      used.insert(material.pbrMetallicRoughness.baseColorTexture.index);
      used.insert(material.emissiveTexture.index);
      if (options_.gloss) {
        used.insert(material.pbrMetallicRoughness.metallicRoughnessTexture.index);
        used.insert(material.normalTexture.index);
      }
      if (const auto* e = FindExtension(material.extensions, kSpecularGlossiness)) {
        used.insert(InfoOf(*e, "diffuseTexture").index);
      }
    }
    std::vector<Blob> images(model_.images.size());
    for (size_t t = 0; t < model_.textures.size(); ++t) {
      const auto& source = model_.textures[t];
      Texture texture;
      texture.name = Indexed("textures", t);
      if (used.count(static_cast<int>(t)) != 0 && source.source < 0) {
        Note(texture.name + " has no image of a kind that is read (PNG, JPEG) and is ignored");
      }
      if (used.count(static_cast<int>(t)) != 0 && source.source >= 0) {
        const auto i = static_cast<size_t>(source.source);
        auto& image = model_.images[i];
        texture.name = image.uri.empty() || IsDataUri(image.uri) ? NameOr(image.name, "image", i)
                                                                 : DecodeUri(image.uri);
        if (images[i].size() == 0) {
          if (!image.image.empty()) {
            const auto bytes = std::as_bytes(std::span(image.image));
            images[i] = Blob::FromVector({bytes.begin(), bytes.end()});
            image.image.clear();
          } else {
            auto file = asset_.Find(DecodeUri(image.uri));
            if (!file.ok())
              return Annotate(file.status(), asset_.root + ": " + Indexed("images", i));
            images[i] = *std::move(file);
          }
        }
        texture.encoded = images[i];
        if (source.sampler >= 0) {
          const auto& sampler = model_.samplers[static_cast<size_t>(source.sampler)];
          texture.wrap_s = ToWrapMode(sampler.wrapS);
          texture.wrap_t = ToWrapMode(sampler.wrapT);
          texture.nearest = sampler.magFilter == TINYGLTF_TEXTURE_FILTER_NEAREST;
        }
      }
      scene_.textures.push_back(std::move(texture));
    }
    return absl::OkStatus();
  }

  TextureRef ImportTextureRef(const TextureInfo& info, const std::string& place) {
    TextureRef ref;
    if (info.index < 0 || model_.textures[static_cast<size_t>(info.index)].source < 0) return ref;
    ref.texture = info.index;
    double uv_set = info.uv_set;
    if (const auto* transform = info.transform) {
      uv_set = NumberOr(*transform, "texCoord", uv_set);
      const auto pair = [&](const char* key, Vec2f fallback) -> Vec2f {
        if (!transform->Has(key)) return fallback;
        const auto& value = transform->Get(key);
        return {static_cast<float>(value.Get(0).GetNumberAsDouble()),
                static_cast<float>(value.Get(1).GetNumberAsDouble())};
      };
      ref.transform.offset = pair("offset", {0, 0});
      ref.transform.scale = pair("scale", {1, 1});
      ref.transform.rotation_rad = static_cast<float>(NumberOr(*transform, "rotation", 0));
    }
    if (uv_set > 1) {
      Note(place + " uses TEXCOORD_" + std::to_string(static_cast<int>(uv_set)) +
           "; only sets 0 and 1 are read, so the texture is ignored");
      return {};
    }
    ref.uv_set = static_cast<uint32_t>(uv_set);
    return ref;
  }

  void ImportMaterials() {
    size_t blended = 0;
    for (size_t m = 0; m < model_.materials.size(); ++m) {
      const auto& source = model_.materials[m];
      const auto& pbr = source.pbrMetallicRoughness;
      const std::string place = Indexed("materials", m);
      Material material;
      material.name = NameOr(source.name, "material", m);
      std::vector<double> factor = pbr.baseColorFactor;
      TextureInfo texture = InfoOf(pbr.baseColorTexture);
      std::string texture_place = place + "/pbrMetallicRoughness/baseColorTexture";
      material.metallic = static_cast<float>(pbr.metallicFactor);
      material.roughness = static_cast<float>(pbr.roughnessFactor);
      bool metal_roughness = true;
      // Its diffuse colour is what a Lambert surface shows; the metallic variant is a stand-in.
      if (const auto* e = FindExtension(source.extensions, kSpecularGlossiness)) {
        factor = {1, 1, 1, 1};
        if (e->Has("diffuseFactor")) {
          for (size_t c = 0; c < 4; ++c) {
            factor[c] = e->Get("diffuseFactor").Get(c).GetNumberAsDouble();
          }
        }
        texture = InfoOf(*e, "diffuseTexture");
        texture_place = place + "/extensions/" + kSpecularGlossiness + "/diffuseTexture";
        metal_roughness = false;
        material.metallic = 0;
        material.roughness = 1;
      }
      if (factor.size() == 4) {
        bool above_one = false;
        for (int c = 0; c < 3; ++c) {
          const double value = factor[static_cast<size_t>(c)];
          above_one |= value > 1;
          material.base_color[c] = static_cast<float>(std::min(value, 1.0));
        }
        if (above_one) Note(place + ": a base colour above 1 would create light; taken as 1");
        material.base_alpha = static_cast<float>(std::min(factor[3], 1.0));
      }
      material.base_color_texture = ImportTextureRef(texture, texture_place);
      if (const auto* e = FindExtension(source.extensions, "KHR_materials_ior")) {
        material.dielectric_f0 = ReflectanceOf(NumberOr(*e, "ior", 1.5));
      }
      if (options_.gloss) {
        if (metal_roughness) {
          material.metal_roughness_texture =
              ImportTextureRef(InfoOf(pbr.metallicRoughnessTexture),
                               place + "/pbrMetallicRoughness/metallicRoughnessTexture");
        }
        const auto& normal = source.normalTexture;
        material.normal_texture =
            ImportTextureRef({normal.index, normal.texCoord,
                              FindExtension(normal.extensions, "KHR_texture_transform")},
                             place + "/normalTexture");
        material.normal_scale = static_cast<float>(normal.scale);
      }
      if (source.alphaMode == "MASK") {
        material.alpha_mode = AlphaMode::kMask;
        material.alpha_cutoff = static_cast<float>(source.alphaCutoff);
      } else if (source.alphaMode == "BLEND") {
        material.alpha_mode = AlphaMode::kMask;
        material.alpha_cutoff = 0.5f;
        ++blended;
      }
      double strength = 1;
      if (const auto* e = FindExtension(source.extensions, "KHR_materials_emissive_strength")) {
        strength = NumberOr(*e, "emissiveStrength", 1);
      }
      if (source.emissiveFactor.size() == 3) {
        for (int c = 0; c < 3; ++c) {
          material.emission[c] =
              static_cast<float>(source.emissiveFactor[static_cast<size_t>(c)] * strength);
        }
      }
      material.emission_texture =
          ImportTextureRef(InfoOf(source.emissiveTexture), place + "/emissiveTexture");
      scene_.materials.push_back(std::move(material));
    }
    if (blended > 0) {
      Note(Counted(blended, "material") +
           " of alphaMode BLEND: cut out where alpha is below 0.5 instead of blended");
    }
  }

  absl::Status ImportMeshes() {
    meshes_.resize(model_.meshes.size());
    for (size_t m = 0; m < model_.meshes.size(); ++m) {
      const auto& mesh = model_.meshes[m];
      for (size_t p = 0; p < mesh.primitives.size(); ++p) {
        const std::string place = Indexed("meshes", m) + Indexed("primitives", p);
        FP_RETURN_IF_ERROR(ImportPrimitive(mesh, m, p, place));
      }
    }
    return absl::OkStatus();
  }

  absl::Status ImportPrimitive(const tinygltf::Mesh& source_mesh, size_t mesh_index,
                               size_t primitive_index, const std::string& place) {
    const tinygltf::Primitive& primitive = source_mesh.primitives[primitive_index];
    if (primitive.mode < TINYGLTF_MODE_TRIANGLES) {
      ++skipped_lines_;
      return absl::OkStatus();
    }
    const auto position = primitive.attributes.find("POSITION");
    if (position == primitive.attributes.end()) {
      ++skipped_empty_;
      return absl::OkStatus();
    }
    const AccessorReader positions(model_, position->second);
    if (!positions.SparseIndicesAreValid()) {
      return Fail(place + "/attributes/POSITION",
                  "the indices of its sparse accessor do not "
                  "ascend inside of the accessor; correct the file or export it again");
    }
    Mesh mesh;
    mesh.name = NameOr(source_mesh.name, "mesh", mesh_index);
    mesh.material = primitive.material;
    std::vector<uint32_t> corners;
    FP_RETURN_IF_ERROR(ReadCorners(primitive, positions.count(), place, corners));
    FP_RETURN_IF_ERROR(MakeTriangles(primitive.mode, corners, place, mesh));
    if (mesh.triangles.empty()) {
      ++skipped_empty_;
      return absl::OkStatus();
    }
    // Many exporters let the primitives of a mesh share one big vertex buffer.
    std::vector<uint32_t> used = CompactVertices(mesh, positions.count());
    mesh.positions.reserve(used.size());
    for (const uint32_t v : used) {
      const Vec3f p = positions.Get3(v);
      if (!farpoint::IsFinite(p)) {
        return Fail(place + "/attributes/POSITION",
                    "position " + std::to_string(v) +
                        " is not finite; correct the file or export it again");
      }
      mesh.positions.push_back(p);
    }
    FP_RETURN_IF_ERROR(ReadAttribute(primitive, "NORMAL", place, [&](const AccessorReader& reader) {
      for (const uint32_t v : used) mesh.normals.push_back(reader.Get3(v));
    }));
    for (size_t set = 0; set < 2; ++set) {
      const std::string name = "TEXCOORD_" + std::to_string(set);
      FP_RETURN_IF_ERROR(ReadAttribute(primitive, name, place, [&](const AccessorReader& reader) {
        for (const uint32_t v : used) {
          const Vec2f uv = reader.Get2(v);
          const bool finite = std::isfinite(uv.x) && std::isfinite(uv.y);
          mesh.uv[set].push_back(finite ? uv : Vec2f{});
          bad_uvs_ += finite ? 0 : 1;
        }
      }));
    }
    if (mesh.material >= 0) NoteMissingUvs(mesh, place);
    FP_RETURN_IF_ERROR(ApplyVertexColors(primitive, used, place, mesh));
    meshes_[mesh_index].push_back(static_cast<uint32_t>(scene_.meshes.size()));
    scene_.meshes.push_back(std::move(mesh));
    const bool deforms = !primitive.targets.empty() || primitive.attributes.count("JOINTS_0") != 0;
    sources_.push_back({mesh_index, primitive_index, {}});
    if (deforms) sources_.back().vertices = std::move(used);
    return absl::OkStatus();
  }

  // COLOR_0 multiplies the base colour (glTF specification, section 3.9.2). One colour for all
  // vertices is exact; more are shown in their mean.
  absl::Status ApplyVertexColors(const tinygltf::Primitive& primitive,
                                 const std::vector<uint32_t>& used, const std::string& place,
                                 Mesh& mesh) {
    std::vector<Rgb> colors, alphas;
    FP_RETURN_IF_ERROR(
        ReadAttribute(primitive, "COLOR_0", place, [&](const AccessorReader& reader) {
          const int type =
              model_.accessors[static_cast<size_t>(primitive.attributes.at("COLOR_0"))].type;
          for (const uint32_t v : used) {
            Rgb color = reader.Get3(v);
            for (int c = 0; c < 3; ++c) {
              color[c] = color[c] >= 0 ? std::min(color[c], 1.0f) : 0.0f;  // NaN: 0
            }
            const double alpha = type == TINYGLTF_TYPE_VEC4 ? reader.Get(v, 3) : 1;
            colors.push_back(color);
            alphas.push_back(Rgb(alpha >= 0 ? static_cast<float>(std::min(alpha, 1.0)) : 0.0f));
          }
        }));
    if (colors.empty()) return absl::OkStatus();
    const auto all_equal = [](const std::vector<Rgb>& values) {
      return std::all_of(values.begin(), values.end(),
                         [&](const Rgb& value) { return value == values[0]; });
    };
    Rgb color = colors[0], alpha = alphas[0];
    if (!all_equal(colors) || !all_equal(alphas)) {
      color = MeanColor(mesh, colors);
      alpha = MeanColor(mesh, alphas);
      ++mean_colors_;
    }
    if (color == Rgb(1) && alpha.x == 1) return absl::OkStatus();
    const auto [it, is_new] =
        colored_materials_.try_emplace({mesh.material, color.x, color.y, color.z, alpha.x},
                                       static_cast<int32_t>(scene_.materials.size()));
    if (is_new) {
      Material material =
          mesh.material >= 0 ? scene_.materials[static_cast<size_t>(mesh.material)] : Material();
      material.base_color *= color;
      material.base_alpha *= alpha.x;
      scene_.materials.push_back(std::move(material));
    }
    mesh.material = it->second;
    return absl::OkStatus();
  }

  template <typename Body>
  absl::Status ReadAttribute(const tinygltf::Primitive& primitive, const std::string& name,
                             const std::string& place, const Body& body) {
    const auto it = primitive.attributes.find(name);
    if (it == primitive.attributes.end()) return absl::OkStatus();
    const AccessorReader reader(model_, it->second);
    if (!reader.SparseIndicesAreValid()) {
      return Fail(place + "/attributes/" + name,
                  "the indices of its sparse accessor do not "
                  "ascend inside of the accessor; correct the file or export it again");
    }
    body(reader);
    return absl::OkStatus();
  }

  // The primitive's vertex indices, each below `vertex_count`.
  absl::Status ReadCorners(const tinygltf::Primitive& primitive, size_t vertex_count,
                           const std::string& place, std::vector<uint32_t>& corners) {
    if (vertex_count > std::numeric_limits<uint32_t>::max()) {
      return Fail(place, "has more than 2^32 vertices; split the mesh");
    }
    const bool indexed = primitive.indices >= 0;
    const size_t count =
        indexed ? model_.accessors[static_cast<size_t>(primitive.indices)].count : vertex_count;
    const uint64_t triangles =
        primitive.mode == TINYGLTF_MODE_TRIANGLES ? count / 3 : (count < 3 ? 0 : count - 2);
    mesh_triangles_ += triangles;
    if (mesh_triangles_ > options_.max_triangles) return TooManyTriangles(place);
    if (triangles == 0) return absl::OkStatus();
    corners.resize(count);
    if (!indexed) {
      for (size_t i = 0; i < count; ++i) corners[i] = static_cast<uint32_t>(i);
      return absl::OkStatus();
    }
    const AccessorReader reader(model_, primitive.indices);
    if (!reader.SparseIndicesAreValid()) {
      return Fail(place + "/indices",
                  "the indices of its sparse accessor do not ascend inside of "
                  "the accessor; correct the file or export it again");
    }
    for (size_t i = 0; i < count; ++i) {
      corners[i] = static_cast<uint32_t>(reader.Get(i, 0));
      if (corners[i] >= vertex_count) {
        return Fail(place + "/indices", "index " + std::to_string(corners[i]) + " is beyond the " +
                                            std::to_string(vertex_count) +
                                            " positions; correct the file or export it "
                                            "again");
      }
    }
    return absl::OkStatus();
  }

  absl::Status MakeTriangles(int mode, const std::vector<uint32_t>& corners,
                             const std::string& place, Mesh& mesh) {
    const size_t count = corners.size();
    if (mode == TINYGLTF_MODE_TRIANGLES) {
      if (count % 3 != 0) {
        return Fail(place, "has " + std::to_string(count) +
                               " indices, which is no multiple of 3; "
                               "correct the file or export it again");
      }
      mesh.triangles.reserve(count / 3);
      for (size_t i = 0; i + 2 < count; i += 3) {
        mesh.triangles.push_back({corners[i], corners[i + 1], corners[i + 2]});
      }
      return absl::OkStatus();
    }
    for (size_t i = 0; i + 2 < count; ++i) {
      // glTF specification, section 3.7.2.1: winding alternates along a strip.
      if (mode == TINYGLTF_MODE_TRIANGLE_STRIP) {
        mesh.triangles.push_back({corners[i], corners[i + 1 + i % 2], corners[i + 2 - i % 2]});
      } else {
        mesh.triangles.push_back({corners[i + 1], corners[i + 2], corners[0]});
      }
    }
    return absl::OkStatus();
  }

  // Renumbers the triangles' vertices to those that are used, in ascending order, and returns the
  // old index of each new one. Costs no more than the triangles, however large the buffer is.
  static std::vector<uint32_t> CompactVertices(Mesh& mesh, size_t vertex_count) {
    std::vector<uint32_t> used;
    if (mesh.triangles.size() * 16 < vertex_count) {
      for (const auto& t : mesh.triangles) used.insert(used.end(), t.begin(), t.end());
      std::sort(used.begin(), used.end());
      used.erase(std::unique(used.begin(), used.end()), used.end());
      for (auto& t : mesh.triangles) {
        for (auto& v : t) {
          v = static_cast<uint32_t>(std::lower_bound(used.begin(), used.end(), v) - used.begin());
        }
      }
      return used;
    }
    constexpr uint32_t kUnused = std::numeric_limits<uint32_t>::max();
    std::vector<uint32_t> new_index(vertex_count, kUnused);
    for (const auto& t : mesh.triangles) {
      for (const uint32_t v : t) new_index[v] = 0;
    }
    for (size_t v = 0; v < vertex_count; ++v) {
      if (new_index[v] == kUnused) continue;
      new_index[v] = static_cast<uint32_t>(used.size());
      used.push_back(static_cast<uint32_t>(v));
    }
    for (auto& t : mesh.triangles) {
      for (auto& v : t) v = new_index[v];
    }
    return used;
  }

  void NoteMissingUvs(const Mesh& mesh, const std::string& place) {
    const Material& material = scene_.materials[static_cast<size_t>(mesh.material)];
    for (const TextureRef* ref : {&material.base_color_texture, &material.emission_texture,
                                  &material.metal_roughness_texture, &material.normal_texture}) {
      if (ref->present() && mesh.uv[ref->uv_set].empty()) {
        Note(place + " has no TEXCOORD_" + std::to_string(ref->uv_set) +
             ", which the texture of '" + material.name + "' needs; its texel at (0, 0) is used");
        return;
      }
    }
  }

  // The roots of the scene that is shown.
  std::vector<int> RootNodes() {
    if (!model_.scenes.empty()) {
      if (model_.defaultScene < 0 && model_.scenes.size() > 1) {
        Note("no default scene: the first of " + std::to_string(model_.scenes.size()) + " is used");
      }
      return model_.scenes[SceneIndex()].nodes;
    }
    std::vector<bool> is_child(model_.nodes.size(), false);
    for (const auto& node : model_.nodes) {
      for (const int child : node.children) is_child[static_cast<size_t>(child)] = true;
    }
    std::vector<int> roots;
    for (size_t n = 0; n < model_.nodes.size(); ++n) {
      if (!is_child[n]) roots.push_back(static_cast<int>(n));
    }
    if (!model_.nodes.empty()) Note("no scene in the file: all its nodes are used");
    return roots;
  }

  size_t SceneIndex() const {
    return model_.defaultScene < 0 ? 0 : static_cast<size_t>(model_.defaultScene);
  }

  // Each node is visited once: a second visit means two parents or a cycle, which glTF forbids.
  absl::Status ImportNodes() {
    struct Visit {
      int node;
      int parent;
      Affine world_from_parent;
    };
    std::vector<Visit> stack;
    const std::vector<int> roots = RootNodes();
    for (auto it = roots.rbegin(); it != roots.rend(); ++it) stack.push_back({*it, -1, {}});
    std::vector<size_t> order;
    world_from_node_.resize(model_.nodes.size());
    while (!stack.empty()) {
      const Visit visit = stack.back();
      stack.pop_back();
      const auto n = static_cast<size_t>(visit.node);
      const std::string place = Indexed("nodes", n);
      if (world_from_node_[n]) {
        return Fail(place, "is reached twice" +
                               (visit.parent < 0 ? std::string(" as a root of the scene")
                                                 : ", the second time from node " +
                                                       std::to_string(visit.parent)) +
                               "; nodes must form a tree: correct the file or export it again");
      }
      const auto& node = model_.nodes[n];
      const Affine world_from_node = visit.world_from_parent * LocalTransform(node);
      if (!IsFinite(world_from_node)) {
        return Fail(place, "its transform is beyond the range of numbers; scale the scene down");
      }
      world_from_node_[n] = world_from_node;
      order.push_back(n);
      for (auto it = node.children.rbegin(); it != node.children.rend(); ++it) {
        stack.push_back({*it, visit.node, world_from_node});
      }
    }
    const size_t unreached = model_.nodes.size() - order.size();
    // A cycle without a root is not reached at all.
    if (model_.scenes.empty() && unreached > 0) {
      return Fail("/nodes",
                  Counted(unreached, "node") +
                      " form cycles; nodes must form a tree: correct the file or export it again");
    }
    // Skins need the places of all joints first.
    for (const size_t n : order) FP_RETURN_IF_ERROR(ImportNode(n));
    return absl::OkStatus();
  }

  absl::Status ImportNode(size_t n) {
    const tinygltf::Node& node = model_.nodes[n];
    const Affine& world_from_node = *world_from_node_[n];
    const std::string name = NameOr(node.name, "node", n);
    if (node.mesh >= 0) FP_RETURN_IF_ERROR(ImportMeshNode(node, n, name, world_from_node));
    if (node.camera >= 0) ImportCamera(node.camera, name, world_from_node);
    if (const auto* e = FindExtension(node.extensions, "KHR_lights_punctual")) {
      const auto light = static_cast<size_t>(NumberOr(*e, "light", 0));
      return ImportLight(light, Indexed("nodes", n), name, world_from_node);
    }
    return absl::OkStatus();
  }

  absl::Status ImportMeshNode(const tinygltf::Node& node, size_t n, const std::string& name,
                              const Affine& world_from_node) {
    const std::string place = Indexed("nodes", n);
    std::vector<Affine> copies = {Affine()};  // node from instance
    if (const auto* e = FindExtension(node.extensions, "EXT_mesh_gpu_instancing")) {
      FP_ASSIGN_OR_RETURN(copies, ReadInstances(*e, place));
    }
    const auto& weights = !node.weights.empty()
                              ? node.weights
                              : model_.meshes[static_cast<size_t>(node.mesh)].weights;
    const bool morphed =
        std::any_of(weights.begin(), weights.end(), [](double weight) { return weight != 0; });
    for (const uint32_t base : meshes_[static_cast<size_t>(node.mesh)]) {
      uint32_t mesh = base;
      Affine world_from_mesh = world_from_node;
      const auto& source = sources_[base];
      const auto& primitive = model_.meshes[source.mesh].primitives[source.primitive];
      Deformation deformation;
      if (morphed && !primitive.targets.empty()) deformation.weights = weights;
      if (node.skin >= 0 && primitive.attributes.count("JOINTS_0") != 0 &&
          primitive.attributes.count("WEIGHTS_0") != 0) {
        FP_ASSIGN_OR_RETURN(deformation.world_from_bind, WorldFromBind(node.skin));
      }
      const bool is_skinned = !deformation.world_from_bind.empty();
      FP_RETURN_IF_ERROR(CountTriangles(base, is_skinned ? 1 : copies.size(), place));
      if (is_skinned || !deformation.weights.empty()) {
        FP_ASSIGN_OR_RETURN(
            DeformedMesh deformed,
            DeformMesh(model_, primitive, scene_.meshes[base], source.vertices, deformation,
                       asset_.root + ": " + Indexed("meshes", source.mesh) +
                           Indexed("primitives", source.primitive)));
        mesh = static_cast<uint32_t>(scene_.meshes.size());
        scene_.meshes.push_back(std::move(deformed.mesh));
        if (deformed.in_world) {
          world_from_mesh = Affine();
          world_from_mesh.translation = deformed.world_offset;
        }
      }
      if (is_skinned) {  // a skin takes the place of its node
        scene_.instances.push_back({name, mesh, world_from_mesh});
        continue;
      }
      for (const Affine& copy : copies) {
        scene_.instances.push_back({name, mesh, world_from_mesh * copy});
      }
    }
    return absl::OkStatus();
  }

  absl::Status CountTriangles(uint32_t mesh, size_t copies, const std::string& place) {
    // Each factor is below 2^36.
    instanced_triangles_ += scene_.meshes[mesh].triangles.size() * uint64_t{copies};
    return instanced_triangles_ > options_.max_triangles ? TooManyTriangles(place)
                                                         : absl::OkStatus();
  }

  // EXT_mesh_gpu_instancing: translation, rotation and scale of each copy, in the node's frame.
  absl::StatusOr<std::vector<Affine>> ReadInstances(const tinygltf::Value& extension,
                                                    const std::string& node_place) {
    const std::string place = node_place + "/extensions/EXT_mesh_gpu_instancing/attributes";
    if (!extension.Has("attributes")) return std::vector<Affine>{Affine()};
    const tinygltf::Value& attributes = extension.Get("attributes");
    std::optional<AccessorReader> readers[3];
    const char* const names[3] = {"TRANSLATION", "ROTATION", "SCALE"};
    std::optional<size_t> count;
    for (int i = 0; i < 3; ++i) {
      if (!attributes.Has(names[i])) continue;
      readers[i].emplace(model_, static_cast<int>(NumberOr(attributes, names[i], 0)));
      if (!readers[i]->SparseIndicesAreValid()) {
        return Fail(place + "/" + names[i],
                    "the indices of its sparse accessor do not ascend inside of the accessor; "
                    "correct the file or export it again");
      }
      count = readers[i]->count();
    }
    if (!count) return std::vector<Affine>{Affine()};
    // Before anything of that size is allocated.
    if (*count > options_.max_triangles) return TooManyTriangles(place);
    std::vector<Affine> copies(*count);
    for (size_t k = 0; k < copies.size(); ++k) {
      if (readers[1]) {
        copies[k] = RotationOf({readers[1]->Get(k, 0), readers[1]->Get(k, 1), readers[1]->Get(k, 2),
                                readers[1]->Get(k, 3)});
      }
      if (readers[2]) {
        const Vec3d scale = readers[2]->Get3d(k);
        for (int c = 0; c < 3; ++c) copies[k].column[c] *= scale[c];
      }
      if (readers[0]) copies[k].translation = readers[0]->Get3d(k);
      if (!IsFinite(copies[k])) {
        return Fail(place, "instance " + std::to_string(k) +
                               " is not finite; correct the file or export it again");
      }
    }
    return copies;
  }

  // Of each joint: where a point of the mesh as it was bound goes to in the world.
  absl::StatusOr<std::vector<Affine>> WorldFromBind(int skin_index) {
    if (const auto it = world_from_bind_.find(skin_index); it != world_from_bind_.end()) {
      return it->second;
    }
    const auto& skin = model_.skins[static_cast<size_t>(skin_index)];
    const std::string place = Indexed("skins", static_cast<size_t>(skin_index));
    std::optional<AccessorReader> matrices;
    if (skin.inverseBindMatrices >= 0) {
      matrices.emplace(model_, skin.inverseBindMatrices);
      if (!matrices->SparseIndicesAreValid()) {
        return Fail(place + "/inverseBindMatrices",
                    "the indices of its sparse accessor do not ascend inside of the accessor; "
                    "correct the file or export it again");
      }
    }
    std::vector<Affine> world_from_bind(skin.joints.size());
    for (size_t j = 0; j < skin.joints.size(); ++j) {
      const auto& world_from_joint = world_from_node_[static_cast<size_t>(skin.joints[j])];
      if (!world_from_joint) {
        return Fail(place + "/joints/" + std::to_string(j),
                    "node " + std::to_string(skin.joints[j]) +
                        " is not part of the scene that is shown; add it to the scene");
      }
      Affine joint_from_bind;
      if (matrices) {
        for (int c = 0; c < 3; ++c) {
          joint_from_bind.column[c] = {matrices->Get(j, 4 * c), matrices->Get(j, 4 * c + 1),
                                       matrices->Get(j, 4 * c + 2)};
        }
        joint_from_bind.translation = {matrices->Get(j, 12), matrices->Get(j, 13),
                                       matrices->Get(j, 14)};
      }
      world_from_bind[j] = *world_from_joint * joint_from_bind;
      if (!IsFinite(world_from_bind[j])) {
        return Fail(place + "/joints/" + std::to_string(j),
                    "its matrix is not finite; correct the file or export it again");
      }
    }
    world_from_bind_.emplace(skin_index, world_from_bind);
    return world_from_bind;
  }

  void ImportCamera(int index, const std::string& node_name, const Affine& world_from_node) {
    const auto& source = model_.cameras[static_cast<size_t>(index)];
    const std::string place = Indexed("cameras", static_cast<size_t>(index));
    if (source.type != "perspective") {
      Note(place + " is orthographic, which is not supported, and is ignored");
      return;
    }
    Camera camera;
    camera.name = node_name.empty() ? source.name : node_name;
    camera.yfov_rad = source.perspective.yfov;
    camera.eye = world_from_node.translation;
    // glTF: scale does not change a camera, and the frame's width follows from its resolution.
    const Vec3d forward = NormalizeOr(-world_from_node.column[2], Vec3d());
    const Vec3d up_hint = NormalizeOr(world_from_node.column[1], Vec3d());
    const Vec3d right = NormalizeOr(Cross(forward, up_hint), Vec3d());
    if (!(Length2(right) > 0.5)) {
      Note(place + " has no orientation (a singular transform) and is ignored");
      return;
    }
    camera.forward = forward;
    camera.right = right;
    camera.up = Cross(right, forward);
    scene_.cameras.push_back(camera);
  }

  absl::Status ImportLight(size_t index, const std::string& place, const std::string& node_name,
                           const Affine& world_from_node) {
    const auto& source = model_.lights[index];
    PunctualLight light;
    light.name = node_name;
    light.kind = source.type == "point"  ? PunctualKind::kPoint
                 : source.type == "spot" ? PunctualKind::kSpot
                                         : PunctualKind::kDirectional;
    const double unit = options_.light_units == LightUnits::kPhotometric ? 1 / kLumensPerWatt : 1;
    // An empty colour is what tinygltf leaves where the file has none: white.
    for (int c = 0; c < 3; ++c) {
      const double color = source.color.size() == 3 ? source.color[static_cast<size_t>(c)] : 1;
      light.intensity[c] = static_cast<float>(color * source.intensity * unit);
    }
    if (!farpoint::IsFinite(light.intensity)) {
      return Fail(Indexed("extensions/KHR_lights_punctual/lights", index),
                  "its intensity is beyond the range of numbers; lower it");
    }
    light.position = world_from_node.translation;
    light.direction = NormalizeOr(-world_from_node.column[2], Vec3d());
    if (light.kind != PunctualKind::kPoint && !(Length2(light.direction) > 0.5)) {
      return Fail(place, "the transform of its light has no direction; correct its scale");
    }
    light.range_m = source.range;
    light.inner_cone_rad = source.spot.innerConeAngle;
    light.outer_cone_rad = source.spot.outerConeAngle;
    if (light.kind == PunctualKind::kSpot && light.inner_cone_rad > light.outer_cone_rad) {
      return Fail(Indexed("extensions/KHR_lights_punctual/lights", index) + "/spot",
                  "innerConeAngle is greater than outerConeAngle; swap them");
    }
    scene_.lights.push_back(light);
    return absl::OkStatus();
  }

  // What our own writer leaves in the scene's extras.
  void ImportSky() {
    if (model_.scenes.empty()) return;
    const auto& extras = model_.scenes[SceneIndex()].extras;
    if (!extras.IsObject() || !extras.Has("farpoint_sky")) return;
    const auto& sky = extras.Get("farpoint_sky");
    for (int c = 0; c < 3; ++c) {
      scene_.environment.sky[c] =
          static_cast<float>(sky.Get(static_cast<size_t>(c)).GetNumberAsDouble());
    }
  }

  absl::Status TooManyTriangles(const std::string& place) const {
    return absl::ResourceExhaustedError(asset_.root + ": " + place + ": the scene has more than " +
                                        std::to_string(options_.max_triangles) +
                                        " triangles; simplify it or raise the limit");
  }

  absl::Status CheckTriangleCount() {
    if (scene_.meshes.size() > std::numeric_limits<uint32_t>::max() ||
        scene_.instances.size() > std::numeric_limits<uint32_t>::max()) {
      return TooManyTriangles("/nodes");
    }
    return absl::OkStatus();
  }

  void NoteCounts() {
    if (scene_.instances.empty()) Note("the scene has no triangles");
    if (skipped_lines_ > 0) {
      Note(Counted(skipped_lines_, "primitive") + " of points or lines skipped");
    }
    if (skipped_empty_ > 0)
      Note(Counted(skipped_empty_, "primitive") + " without triangles skipped");
    if (mean_colors_ > 0) {
      Note(Counted(mean_colors_, "primitive") +
           " with colours at the vertices (COLOR_0): shown in their mean");
    }
    if (imported_.animation && !options_.time_s) {
      Note(Counted(model_.animations.size(), "animation") +
           " in the file: the rest pose is shown; choose frames to see them move");
    }
    if (bad_uvs_ > 0) {
      Note(Counted(bad_uvs_, "texture coordinate") + " not finite: taken as (0, 0)");
    }
  }

  const AssetBundle& asset_;
  const ImportOptions& options_;
  tinygltf::Model model_;
  Scene scene_;
  ImportedScene imported_;
  std::vector<std::vector<uint32_t>> meshes_;  // by glTF mesh: indices into scene_.meshes
  struct MeshSource {
    size_t mesh, primitive;
    std::vector<uint32_t> vertices;  // the primitive's, if it may be deformed
  };
  std::vector<MeshSource> sources_;                     // as the first of scene_.meshes
  std::vector<std::optional<Affine>> world_from_node_;  // of the nodes that are shown
  std::map<int, std::vector<Affine>> world_from_bind_;  // by skin
  std::map<std::tuple<int32_t, float, float, float, float>, int32_t> colored_materials_;
  uint64_t mesh_triangles_ = 0, instanced_triangles_ = 0;
  size_t skipped_lines_ = 0, skipped_empty_ = 0, bad_uvs_ = 0, mean_colors_ = 0;
};

}  // namespace

absl::StatusOr<ImportedScene> ImportGltf(const AssetBundle& asset, const ImportOptions& options) {
  return Importer(asset, options).Run();
}

absl::StatusOr<std::optional<TimeRange>> FindGltfAnimation(const AssetBundle& asset) {
  const ImportOptions options;
  return Importer(asset, options).FindAnimation();
}

}  // namespace farpoint
