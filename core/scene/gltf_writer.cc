#include <algorithm>
#include <array>
#include <cmath>
#include <cstring>
#include <filesystem>
#include <map>
#include <nlohmann/json.hpp>
#include <utility>
#include <vector>

#include "core/base/hash.h"
#include "core/scene/procedural.h"
#include "core/scene/scene_format.h"

namespace farpoint {

namespace {

// Keeps the order in which members are written.
using Json = nlohmann::ordered_json;

constexpr double kLumensPerWatt = 683.0;  // what ImportScene divides by

Json ToJson(const Rgb& c) { return Json::array({c.x, c.y, c.z}); }
Json ToJson(const Vec3d& v) { return Json::array({v.x, v.y, v.z}); }

// Columns and translation as glTF's matrix.
Json MatrixOf(const Affine& m) {
  Json matrix = Json::array();
  for (const Vec3d& column : m.column) {
    for (int i = 0; i < 3; ++i) matrix.push_back(column[i]);
    matrix.push_back(0.0);
  }
  for (int i = 0; i < 3; ++i) matrix.push_back(m.translation[i]);
  matrix.push_back(1.0);
  return matrix;
}

class Writer {
 public:
  explicit Writer(const Scene& scene) : scene_(scene) {}

  // Everything but the buffer's URI.
  Json Document() {
    root_["asset"] = {{"version", "2.0"}, {"generator", "farpoint"}};
    root_["scene"] = 0;
    root_["scenes"] = Json::array({Json{{"name", scene_.name}}});
    WriteTextures();
    WriteMaterials();
    for (const Mesh& mesh : scene_.meshes) WriteMesh(mesh);
    for (const Instance& instance : scene_.instances) {
      Json node = {{"name", instance.name}, {"mesh", instance.mesh}};
      PlaceNode(instance.world_from_mesh, node);
      AddNode(std::move(node));
    }
    for (const Camera& camera : scene_.cameras) WriteCamera(camera);
    for (const PunctualLight& light : scene_.lights) WriteLight(light);
    Json& gltf_scene = root_["scenes"][0];
    if (MaxComponent(scene_.environment.sky) > 0) {
      gltf_scene["extras"] = {{"farpoint_sky", ToJson(scene_.environment.sky)}};
    }
    if (!extensions_.empty()) {
      Json used = Json::array();
      for (const auto& [name, unused] : extensions_) used.push_back(name);
      root_["extensionsUsed"] = used;
    }
    if (!bytes_.empty()) root_["buffers"] = Json::array({Json{{"byteLength", bytes_.size()}}});
    return root_;
  }

  std::vector<std::byte>& bytes() { return bytes_; }

 private:
  void Use(const char* extension) { extensions_[extension] = true; }

  size_t Append(const char* array, Json element) {
    root_[array].push_back(std::move(element));
    return root_[array].size() - 1;
  }

  void AddNode(Json node) {
    root_["scenes"][0]["nodes"].push_back(Append("nodes", std::move(node)));
  }

  static void PlaceNode(const Affine& m, Json& node) {
    Affine at_origin = m;
    at_origin.translation = {};
    if (!(at_origin == Affine())) {
      node["matrix"] = MatrixOf(m);
    } else if (!(m.translation == Vec3d())) {
      node["translation"] = ToJson(m.translation);
    }
  }

  // A view on bytes appended to the buffer; equal bytes share a view.
  size_t View(std::span<const std::byte> bytes, int target) {
    const auto [it, is_new] = views_.try_emplace({HashBytes(bytes), target}, 0);
    if (!is_new) return it->second;
    bytes_.resize((bytes_.size() + 3) / 4 * 4);
    Json view = {{"buffer", 0}, {"byteOffset", bytes_.size()}, {"byteLength", bytes.size()}};
    if (target != 0) view["target"] = target;
    bytes_.insert(bytes_.end(), bytes.begin(), bytes.end());
    return it->second = Append("bufferViews", std::move(view));
  }

  template <typename T>
  Json Accessor(const std::vector<T>& values, size_t count, int component_type, const char* type,
                int target) {
    return {{"bufferView", View(std::as_bytes(std::span(values)), target)},
            {"componentType", component_type},
            {"count", count},
            {"type", type}};
  }

  // Equal accessors are written once.
  size_t AddAccessor(Json accessor) {
    const auto [it, is_new] = accessors_.try_emplace(accessor.dump(), 0);
    if (is_new) it->second = Append("accessors", std::move(accessor));
    return it->second;
  }

  void WriteMesh(const Mesh& mesh) {
    constexpr int kFloat = 5126, kVertices = 34962, kIndices = 34963;
    Json attributes;
    Json positions = Accessor(mesh.positions, mesh.positions.size(), kFloat, "VEC3", kVertices);
    Box3f box;
    for (const Vec3f& p : mesh.positions) box.Extend(p);
    positions["min"] = ToJson(box.min);
    positions["max"] = ToJson(box.max);
    attributes["POSITION"] = AddAccessor(std::move(positions));
    if (!mesh.normals.empty()) {
      attributes["NORMAL"] =
          AddAccessor(Accessor(mesh.normals, mesh.normals.size(), kFloat, "VEC3", kVertices));
    }
    for (size_t set = 0; set < 2; ++set) {
      if (mesh.uv[set].empty()) continue;
      attributes["TEXCOORD_" + std::to_string(set)] =
          AddAccessor(Accessor(mesh.uv[set], mesh.uv[set].size(), kFloat, "VEC2", kVertices));
    }
    Json primitive = {{"attributes", attributes}};
    const size_t count = mesh.triangles.size() * 3;
    if (mesh.positions.size() <= 65535) {
      std::vector<uint16_t> indices;
      indices.reserve(count);
      for (const auto& t : mesh.triangles) {
        for (const uint32_t v : t) indices.push_back(static_cast<uint16_t>(v));
      }
      primitive["indices"] = AddAccessor(Accessor(indices, count, 5123, "SCALAR", kIndices));
    } else {
      primitive["indices"] = AddAccessor(Accessor(mesh.triangles, count, 5125, "SCALAR", kIndices));
    }
    if (mesh.material >= 0) primitive["material"] = mesh.material;
    Append("meshes", {{"name", mesh.name}, {"primitives", Json::array({primitive})}});
  }

  void WriteTextures() {
    for (const Texture& texture : scene_.textures) {
      const auto bytes = texture.encoded.bytes();
      const bool png = bytes.size() > 3 && std::memcmp(bytes.data() + 1, "PNG", 3) == 0;
      const size_t view = View(bytes, 0);
      const auto [it, is_new] = images_.try_emplace(view, 0);
      if (is_new) {
        it->second = Append("images", {{"name", texture.name},
                                       {"bufferView", view},
                                       {"mimeType", png ? "image/png" : "image/jpeg"}});
      }
      const auto wrap = [](WrapMode mode) {
        return mode == WrapMode::kRepeat           ? 10497
               : mode == WrapMode::kMirroredRepeat ? 33648
                                                   : 33071;
      };
      const size_t sampler = Append("samplers", {{"magFilter", texture.nearest ? 9728 : 9729},
                                                 {"wrapS", wrap(texture.wrap_s)},
                                                 {"wrapT", wrap(texture.wrap_t)}});
      Append("textures", {{"source", it->second}, {"sampler", sampler}});
    }
  }

  Json TextureInfo(const TextureRef& ref) {
    Json info = {{"index", ref.texture}};
    if (ref.uv_set != 0) info["texCoord"] = ref.uv_set;
    const UvTransform& t = ref.transform;
    if (!(t.offset == Vec2f{0, 0}) || !(t.scale == Vec2f{1, 1}) || t.rotation_rad != 0) {
      Use("KHR_texture_transform");
      info["extensions"]["KHR_texture_transform"] = {
          {"offset", Json::array({t.offset.x, t.offset.y})},
          {"scale", Json::array({t.scale.x, t.scale.y})},
          {"rotation", t.rotation_rad}};
    }
    return info;
  }

  void WriteMaterials() {
    for (const Material& m : scene_.materials) {
      Json pbr = {{"baseColorFactor",
                   Json::array({m.base_color.x, m.base_color.y, m.base_color.z, m.base_alpha})},
                  {"metallicFactor", m.metallic},
                  {"roughnessFactor", m.roughness}};
      if (m.base_color_texture.present()) {
        pbr["baseColorTexture"] = TextureInfo(m.base_color_texture);
      }
      if (m.metal_roughness_texture.present()) {
        pbr["metallicRoughnessTexture"] = TextureInfo(m.metal_roughness_texture);
      }
      Json material = {{"name", m.name}, {"doubleSided", true}, {"pbrMetallicRoughness", pbr}};
      if (m.alpha_mode == AlphaMode::kMask) {
        material["alphaMode"] = "MASK";
        material["alphaCutoff"] = m.alpha_cutoff;
      }
      if (m.normal_texture.present()) {
        material["normalTexture"] = TextureInfo(m.normal_texture);
        material["normalTexture"]["scale"] = m.normal_scale;
      }
      const double strength = MaxComponent(m.emission);
      if (strength > 0) {
        // emissiveFactor ends at 1; the strength carries the rest.
        const Vec3d factor = strength > 1 ? Vec3d(m.emission) / strength : Vec3d(m.emission);
        material["emissiveFactor"] = ToJson(factor);
        if (strength > 1) {
          Use("KHR_materials_emissive_strength");
          material["extensions"]["KHR_materials_emissive_strength"]["emissiveStrength"] = strength;
        }
        if (m.emission_texture.present()) {
          material["emissiveTexture"] = TextureInfo(m.emission_texture);
        }
      }
      Append("materials", std::move(material));
    }
  }

  void WriteCamera(const Camera& camera) {
    const size_t index =
        Append("cameras", {{"name", camera.name},
                           {"type", "perspective"},
                           {"perspective", {{"yfov", camera.yfov_rad}, {"znear", 0.01}}}});
    Affine world_from_camera;
    world_from_camera.column[0] = camera.right;
    world_from_camera.column[1] = camera.up;
    world_from_camera.column[2] = -camera.forward;
    world_from_camera.translation = camera.eye;
    Json node = {{"name", camera.name}, {"camera", index}};
    PlaceNode(world_from_camera, node);
    AddNode(std::move(node));
  }

  void WriteLight(const PunctualLight& light) {
    Use("KHR_lights_punctual");
    const double intensity = MaxComponent(light.intensity);
    const char* type = light.kind == PunctualKind::kPoint  ? "point"
                       : light.kind == PunctualKind::kSpot ? "spot"
                                                           : "directional";
    Json object = {{"name", light.name}, {"type", type}, {"intensity", intensity * kLumensPerWatt}};
    if (intensity > 0) object["color"] = ToJson(Vec3d(light.intensity) / intensity);
    if (light.range_m > 0) object["range"] = light.range_m;
    if (light.kind == PunctualKind::kSpot) {
      object["spot"] = {{"innerConeAngle", light.inner_cone_rad},
                        {"outerConeAngle", light.outer_cone_rad}};
    }
    Json& lights = root_["extensions"]["KHR_lights_punctual"]["lights"];
    lights.push_back(std::move(object));
    // The light shines along the node's -z.
    Affine world_from_light;
    if (light.kind != PunctualKind::kPoint) {
      const Vec3d z = -light.direction;
      const Vec3d hint = std::abs(z.y) < 0.9 ? Vec3d(0, 1, 0) : Vec3d(1, 0, 0);
      world_from_light.column[0] = Normalize(Cross(hint, z));
      world_from_light.column[1] = Cross(z, world_from_light.column[0]);
      world_from_light.column[2] = z;
    }
    world_from_light.translation = light.position;
    Json node = {{"name", light.name}};
    PlaceNode(world_from_light, node);
    node["extensions"]["KHR_lights_punctual"]["light"] = lights.size() - 1;
    AddNode(std::move(node));
  }

  const Scene& scene_;
  Json root_;
  std::vector<std::byte> bytes_;
  std::map<std::string, bool> extensions_;
  std::map<std::pair<Digest, int>, size_t> views_;
  std::map<std::string, size_t> accessors_;
  std::map<size_t, size_t> images_;
};

std::string EncodeUri(const std::string& path) {
  std::string encoded;
  for (const char c : path) {
    const bool plain = (c >= 'a' && c <= 'z') || (c >= 'A' && c <= 'Z') || (c >= '0' && c <= '9') ||
                       c == '-' || c == '_' || c == '.' || c == '~';
    if (plain) {
      encoded += c;
    } else {
      constexpr char kDigits[] = "0123456789ABCDEF";
      encoded += {'%', kDigits[static_cast<unsigned char>(c) >> 4],
                  kDigits[static_cast<unsigned char>(c) & 15]};
    }
  }
  return encoded;
}

void AppendChunk(std::vector<std::byte>& file, uint32_t type, std::span<const std::byte> data,
                 std::byte padding) {
  const auto put = [&](uint32_t value) {
    const auto bytes = std::as_bytes(std::span(&value, 1));
    file.insert(file.end(), bytes.begin(), bytes.end());
  };
  const size_t padded = (data.size() + 3) / 4 * 4;
  put(static_cast<uint32_t>(padded));
  put(type);
  file.insert(file.end(), data.begin(), data.end());
  file.resize(file.size() + padded - data.size(), padding);
}

}  // namespace

absl::Status WriteGltf(const Scene& scene, const std::string& path) {
  FP_ASSIGN_OR_RETURN(const SceneFormat format, SceneFormatOf(path));
  if (format != SceneFormat::kGltf) {
    return absl::InvalidArgumentError("'" + path + "' is no name of a glTF file; end it in .gltf " +
                                      "or .glb");
  }
  for (size_t m = 0; m < scene.meshes.size(); ++m) {
    if (!scene.meshes[m].triangles.empty()) continue;
    return absl::InvalidArgumentError("mesh " + std::to_string(m) + " ('" + scene.meshes[m].name +
                                      "') has no triangles, which glTF cannot say; remove it");
  }
  Writer writer(scene);
  Json document = writer.Document();
  std::vector<std::byte>& bin = writer.bytes();
  const std::filesystem::path file(path);
  std::string extension = file.extension().string();
  for (char& c : extension) c = c >= 'A' && c <= 'Z' ? static_cast<char>(c - 'A' + 'a') : c;
  if (extension == ".gltf") {
    if (!bin.empty()) {
      std::filesystem::path bin_path = file;
      bin_path.replace_extension(".bin");
      document["buffers"][0]["uri"] = EncodeUri(bin_path.filename().string());
      FP_RETURN_IF_ERROR(WriteFileAtomically(bin_path.string(), bin));
    }
    const std::string text = document.dump(1, ' ', false, Json::error_handler_t::replace) + "\n";
    return WriteFileAtomically(path, std::as_bytes(std::span(text)));
  }
  const std::string text = document.dump(-1, ' ', false, Json::error_handler_t::replace);
  constexpr uint64_t kMaxGlb = 0xffffffff;
  if (text.size() + bin.size() + 64 > kMaxGlb) {
    return absl::ResourceExhaustedError("'" + path +
                                        "' would have more than the 4 GiB of a .glb; "
                                        "write a .gltf");
  }
  std::vector<std::byte> glb(12);
  AppendChunk(glb, 0x4E4F534A, std::as_bytes(std::span(text)), std::byte{' '});
  if (!bin.empty()) AppendChunk(glb, 0x004E4942, bin, std::byte{0});
  const std::array<uint32_t, 3> header = {0x46546C67, 2, static_cast<uint32_t>(glb.size())};
  std::memcpy(glb.data(), header.data(), sizeof(header));
  return WriteFileAtomically(path, glb);
}

}  // namespace farpoint
