#include "core/scene/prepared_scene.h"

#include <algorithm>
#include <bit>
#include <cmath>
#include <cstddef>
#include <limits>
#include <map>
#include <optional>
#include <utility>

#include "core/base/byte_io.h"
#include "core/base/fp_trap.h"
#include "core/math/elementary.h"
#include "core/math/sampling.h"
#include "core/scene/image_decode.h"

namespace farpoint {

namespace {

constexpr uint64_t kMagic = 0x454e454353504600;  // "\0FPSCENE"
constexpr uint32_t kVersion = 3;

// Squares of lengths up to 2^62 are floats, and so are areas down to 2^-120.
constexpr double kMaxExtentM = 0x1p60;
constexpr double kMinExtentM = 0x1p-30;
constexpr double kMaxOriginM = 0x1p100;
// A triangle is degenerate if its area is below this part of the scene's squared diagonal, or its
// height below about this part of its longest edge.
constexpr double kMinAreaRatio = 0x1p-60;
// A scene so many times the size of its bulk has strays: a backdrop, a forgotten object.
constexpr double kStrayRatio = 16;

// Evenly picked vertices, up to 2^16, that tell where most of a scene lies.
class VertexSample {
 public:
  void Add(const Vec3d& p) {
    if (seen_++ % stride_ != 0) return;
    picked_.push_back(p);
    if (picked_.size() < kMost) return;
    for (size_t i = 0; 2 * i < picked_.size(); ++i) picked_[i] = picked_[2 * i];
    picked_.resize(kMost / 2);
    stride_ *= 2;
  }
  // The box that leaves out an eighth at either end of each axis. Precondition: one was added.
  Box3d Bulk() {
    const auto low = picked_.size() / 8, high = picked_.size() - 1 - low;
    const auto component = [&](double Vec3d::*c, size_t rank) {
      std::ranges::nth_element(picked_, picked_.begin() + static_cast<std::ptrdiff_t>(rank), {}, c);
      return picked_[rank].*c;
    };
    Box3d box;
    box.min = {component(&Vec3d::x, low), component(&Vec3d::y, low), component(&Vec3d::z, low)};
    box.max = {component(&Vec3d::x, high), component(&Vec3d::y, high), component(&Vec3d::z, high)};
    return box;
  }

 private:
  static constexpr size_t kMost = 1u << 16;
  uint64_t seen_ = 0, stride_ = 1;
  std::vector<Vec3d> picked_;
};
constexpr double kMinSliverRatio = 0x1p-44;
constexpr float kMaxRadiance = 1e15f;
constexpr float kMaxUvFactor = 1e10f;
constexpr uint64_t kMaxTexels = uint64_t{1} << 30;
constexpr uint64_t kMaxMapTexels = uint64_t{1} << 26;
constexpr uint64_t kMaxElements = std::numeric_limits<uint32_t>::max();
constexpr size_t kPiece = 1 << 14;

static_assert(sizeof(PreparedTriangle) == 16 && sizeof(PreparedObject) == 32 &&
              sizeof(PreparedMaterial) == 184 && sizeof(PreparedTexture) == 32 &&
              sizeof(PreparedLight) == 56);

// --- Looking up textures ---

std::array<float, 256> MakeSrgbTable() {
  std::array<float, 256> table{};
  for (int i = 0; i < 256; ++i) table[i] = static_cast<float>(SrgbToLinear(i / 255.0));
  return table;
}
const std::array<float, 256> kLinearFromSrgb8 = MakeSrgbTable();

Rgb LinearColor(uint32_t texel) {
  return {kLinearFromSrgb8[texel & 255], kLinearFromSrgb8[(texel >> 8) & 255],
          kLinearFromSrgb8[(texel >> 16) & 255]};
}
float LinearAlpha(uint32_t texel) { return static_cast<float>(texel >> 24) * (1.0f / 255.0f); }

// The two texels around a coordinate and the weight of the second.
struct Tap {
  uint32_t first, second;
  float weight;
};

// `u` brought into the texture's period: [0, 1], or [0, 2] for mirrored repetition.
float Wrap(float u, WrapMode mode) {
  if (!(std::fabs(u) < 1e9f)) return 0.0f;
  switch (mode) {
    case WrapMode::kRepeat:
      return u - std::floor(u);
    case WrapMode::kMirroredRepeat:
      return u - 2.0f * std::floor(0.5f * u);
    default:
      return std::clamp(u, 0.0f, 1.0f);
  }
}

// `i` in [-1, size], or [-1, 2 size] for mirrored repetition.
uint32_t WrapTexel(int32_t i, int32_t size, WrapMode mode) {
  switch (mode) {
    case WrapMode::kRepeat:
      if (i < 0) return static_cast<uint32_t>(size - 1);
      return static_cast<uint32_t>(i >= size ? i - size : i);
    case WrapMode::kMirroredRepeat:
      if (i < 0 || i >= 2 * size) return 0;
      return static_cast<uint32_t>(i >= size ? 2 * size - 1 - i : i);
    default:
      return static_cast<uint32_t>(std::clamp(i, 0, size - 1));
  }
}

Tap LinearTap(float u, uint32_t size, WrapMode mode) {
  const float x = Wrap(u, mode) * static_cast<float>(size) - 0.5f;
  const float floor_x = std::floor(x);
  const auto i = static_cast<int32_t>(floor_x);
  const auto n = static_cast<int32_t>(size);
  return {WrapTexel(i, n, mode), WrapTexel(i + 1, n, mode), x - floor_x};
}

uint32_t NearestTexel(float u, uint32_t size, WrapMode mode) {
  const float x = Wrap(u, mode) * static_cast<float>(size);
  return WrapTexel(static_cast<int32_t>(x), static_cast<int32_t>(size), mode);
}

Vec2f TransformUv(const float (&m)[6], const Vec2f& uv) {
  return {m[0] * uv.x + m[1] * uv.y + m[2], m[3] * uv.x + m[4] * uv.y + m[5]};
}

// --- Geometry ---

Vec3d CrossOf(const Vec3f& a, const Vec3f& b, const Vec3f& c) {
  return Cross(Vec3d(b) - Vec3d(a), Vec3d(c) - Vec3d(a));
}

bool IsDegenerate(const Vec3f& a, const Vec3f& b, const Vec3f& c, double min_area) {
  const double edge2 = std::max(
      {Length2(Vec3d(b) - Vec3d(a)), Length2(Vec3d(c) - Vec3d(a)), Length2(Vec3d(c) - Vec3d(b))});
  const double double_area = Length(CrossOf(a, b, c));
  return !(double_area > kMinSliverRatio * edge2) || !(0.5 * double_area > min_area);
}

// 2^-k with k the exponent of the largest magnitude, so that x * result has largest in [1, 2).
double InversePowerOfTwo(double largest) {
  if (!(largest >= std::numeric_limits<double>::min()) || !std::isfinite(largest)) return 1.0;
  const uint64_t exponent = std::bit_cast<uint64_t>(largest) >> 52;  // biased
  // Exponents near the ends of the range have no exact inverse; nothing real comes near.
  const uint64_t inverse = 2046 - std::min<uint64_t>(exponent, 2045);
  return std::bit_cast<double>(inverse << 52);
}

uint64_t BitsOf(double x) { return std::bit_cast<uint64_t>(x + 0.0); }  // -0 as 0

double LargestEntry(const Affine& m) {
  return std::max({MaxAbs(m.column[0]), MaxAbs(m.column[1]), MaxAbs(m.column[2])});
}

// The linear part without its power of two, which no normal depends on.
Affine NormalizedLinear(const Affine& m) {
  const double scale = InversePowerOfTwo(LargestEntry(m));
  Affine linear;
  for (int c = 0; c < 3; ++c) linear.column[c] = m.column[c] * scale;
  return linear;
}

uint64_t GeometryKey(const Mesh& mesh, const std::vector<bool>& used) {
  float largest = 0;
  for (size_t v = 0; v < mesh.positions.size(); ++v) {
    if (used[v]) largest = std::max(largest, MaxAbs(mesh.positions[v]));
  }
  const double scale = InversePowerOfTwo(largest);
  uint64_t key = HashKey(mesh.positions.size(), mesh.triangles.size());
  for (size_t v = 0; v < mesh.positions.size(); ++v) {
    if (!used[v]) continue;
    const Vec3d p = Vec3d(mesh.positions[v]) * scale;
    for (int c = 0; c < 3; ++c) key = Mix64(key ^ BitsOf(p[c]));
  }
  for (const auto& t : mesh.triangles) {
    key = Mix64(key ^ (t[0] | uint64_t{t[1]} << 32));
    key = Mix64(key ^ t[2]);
  }
  return key;
}

// Coarse enough for the rounding of another unit to vanish.
constexpr double kKeyBits = 0x1p20;

uint64_t ContentKey(uint64_t geometry_key, const Affine& world_from_mesh) {
  const Affine linear = NormalizedLinear(world_from_mesh);
  const double largest = LargestEntry(linear);
  uint64_t key = geometry_key;
  for (const Vec3d& column : linear.column) {
    for (int c = 0; c < 3; ++c) {
      const double part = largest > 0 ? column[c] / largest : column[c];
      key = HashKey(key, BitsOf(std::nearbyint(part * kKeyBits)));
    }
  }
  return key;
}

// --- Checks shared by Prepare and FromBlob ---

bool InRange(const Rgb& c, float max) {
  return c.x >= 0 && c.y >= 0 && c.z >= 0 && c.x <= max && c.y <= max && c.z <= max;
}

bool IsRotation(const std::array<Vec3d, 3>& axes) {
  const auto near = [](double a, double b) { return std::fabs(a - b) < 1e-6; };
  // The largest of NaN and a number may be the number.
  return near(Length2(axes[0]), 1) && near(Length2(axes[1]), 1) && near(Dot(axes[0], axes[1]), 0) &&
         IsFinite(axes[2]) && MaxAbs(Cross(axes[0], axes[1]) - axes[2]) < 1e-6;
}

bool IsHalf(float f) { return HalfToFloat(FloatToHalf(f)) == f; }

bool UsesTexture(const PreparedMaterial& m) {
  return m.base_color_texture >= 0 || m.emission_texture >= 0;
}

// Of a normal with the surface: less would let its light come from below.
constexpr float kLeastBumpCosine = 0.02f;

absl::Status BadBlob(const std::string& text) {
  return absl::DataLossError("prepared scene: " + text +
                             "; the blob is damaged: remove it, so that it is fetched again");
}

// Builds the tables of a prepared scene.
class Builder {
 public:
  Builder(const Scene& scene, Executor& executor, const PrepareOptions& options)
      : scene_(scene), executor_(executor), options_(options) {}

  absl::StatusOr<Blob> Build() {
    FP_RETURN_IF_ERROR(CheckReferences());
    FP_RETURN_IF_ERROR(FindOrigin());
    FP_RETURN_IF_ERROR(BuildMaterials());
    for (size_t i = 0; i < scene_.instances.size(); ++i) FP_RETURN_IF_ERROR(Flatten(i));
    FP_RETURN_IF_ERROR(BuildLights());
    FP_RETURN_IF_ERROR(BuildEnvironment());
    return Serialize();
  }

  // By object, after Build.
  std::vector<uint32_t> TakeObjectInstances() { return std::move(object_instances_); }
  uint64_t skipped_textures() const { return skipped_textures_; }

 private:
  const Mesh& MeshOf(const Instance& instance) const { return scene_.meshes[instance.mesh]; }

  std::string NameOf(const Mesh& mesh) const {
    return "mesh " + std::to_string(&mesh - scene_.meshes.data()) + " ('" + mesh.name + "')";
  }
  std::string NameOf(const Instance& instance) const {
    return "instance " + std::to_string(&instance - scene_.instances.data()) + " ('" +
           instance.name + "') of " + NameOf(MeshOf(instance));
  }

  absl::Status CheckReferences() {
    used_vertices_.resize(scene_.meshes.size());
    for (const Mesh& mesh : scene_.meshes) {
      const size_t count = mesh.positions.size();
      const auto fail = [&](const std::string& text) {
        return absl::InvalidArgumentError(NameOf(mesh) + ": " + text);
      };
      if (count > kMaxElements || mesh.triangles.size() > kMaxElements) {
        return fail("has more than 2^32 vertices or triangles; split it");
      }
      if (!mesh.normals.empty() && mesh.normals.size() != count) {
        return fail("has " + std::to_string(mesh.normals.size()) + " normals for " +
                    std::to_string(count) + " positions; give each position one, or none");
      }
      for (const auto& uv : mesh.uv) {
        if (!uv.empty() && uv.size() != count) {
          return fail("has " + std::to_string(uv.size()) + " texture coordinates for " +
                      std::to_string(count) + " positions; give each position one, or none");
        }
      }
      if (mesh.material < -1 || mesh.material >= static_cast<int64_t>(scene_.materials.size())) {
        return fail("material " + std::to_string(mesh.material) + " does not exist; there are " +
                    std::to_string(scene_.materials.size()));
      }
      auto& used = used_vertices_[static_cast<size_t>(&mesh - scene_.meshes.data())];
      used.assign(count, false);
      for (size_t t = 0; t < mesh.triangles.size(); ++t) {
        for (const uint32_t v : mesh.triangles[t]) {
          if (v >= count) {
            return fail("triangle " + std::to_string(t) + ": index " + std::to_string(v) +
                        " is beyond the " + std::to_string(count) + " positions");
          }
          used[v] = true;
        }
      }
    }
    for (size_t i = 0; i < scene_.instances.size(); ++i) {
      if (scene_.instances[i].mesh >= scene_.meshes.size()) {
        return absl::InvalidArgumentError(
            "instance " + std::to_string(i) + " ('" + scene_.instances[i].name + "'): mesh " +
            std::to_string(scene_.instances[i].mesh) + " does not exist");
      }
    }
    return absl::OkStatus();
  }

  absl::Status FindOrigin() {
    Box3d bounds;
    VertexSample sample;
    uint64_t vertices = 0, triangles = 0;
    for (const Instance& instance : scene_.instances) {
      const Mesh& mesh = MeshOf(instance);
      const auto& used = used_vertices_[instance.mesh];
      vertices += mesh.positions.size();
      triangles += mesh.triangles.size();
      if (vertices > kMaxElements || triangles > kMaxElements) {
        return absl::ResourceExhaustedError(
            NameOf(instance) + ": the scene has more than 2^32 vertices or triangles; simplify it");
      }
      for (size_t v = 0; v < mesh.positions.size(); ++v) {
        if (!used[v]) continue;
        const Vec3d p = instance.world_from_mesh.Point(Vec3d(mesh.positions[v]));
        if (!IsFinite(p)) {
          return absl::InvalidArgumentError(NameOf(instance) + ": vertex " + std::to_string(v) +
                                            " is not finite in the world; correct the mesh or the "
                                            "instance's transform");
        }
        bounds.Extend(p);
        sample.Add(p);
      }
    }
    vertices_.reserve(vertices);
    triangles_.reserve(triangles);
    if (bounds.empty()) return absl::OkStatus();
    // Where the floats are finest: in the middle, but of what most of the scene is.
    const Box3d bulk = sample.Bulk();
    const bool strays = bounds.Diagonal() > kStrayRatio * bulk.Diagonal() && bulk.Diagonal() > 0;
    origin_ = strays ? bulk.Center() : bounds.Center();
    const double diagonal = bounds.Diagonal();
    if (!(diagonal < kMaxExtentM)) {
      return absl::InvalidArgumentError(
          "the scene is more than 2^60 m across, beyond which squared distances overflow; scale it "
          "down or remove what lies far away");
    }
    if (std::max(MaxAbs(bounds.min), MaxAbs(bounds.max)) > kMaxOriginM) {
      return absl::InvalidArgumentError(
          "the scene lies more than 2^100 m from the world's origin, beyond which positions are no "
          "floats; move it closer");
    }
    if (diagonal > 0 && diagonal < kMinExtentM) {
      return absl::InvalidArgumentError(
          "the scene is less than 2^-30 m across, below which areas lose their precision; scale it "
          "up");
    }
    const double extent = strays ? bulk.Diagonal() : diagonal;
    min_area_ = kMinAreaRatio * extent * extent;
    return absl::OkStatus();
  }

  // --- Materials and textures, those that are used ---

  absl::Status BuildMaterials() {
    std::vector<bool> used(scene_.materials.size(), false);
    bool uses_default = false;
    for (const Instance& instance : scene_.instances) {
      const Mesh& mesh = MeshOf(instance);
      if (mesh.triangles.empty()) continue;
      if (mesh.material < 0)
        uses_default = true;
      else
        used[static_cast<size_t>(mesh.material)] = true;
    }
    prepared_material_.assign(scene_.materials.size(), 0);
    prepared_texture_.assign(scene_.textures.size(), -1);
    for (size_t m = 0; m < scene_.materials.size(); ++m) {
      if (!used[m]) continue;
      prepared_material_[m] = static_cast<uint32_t>(materials_.size());
      FP_RETURN_IF_ERROR(AddMaterial(scene_.materials[m], m));
    }
    if (uses_default) {
      default_material_ = static_cast<uint32_t>(materials_.size());
      FP_RETURN_IF_ERROR(AddMaterial(Material(), scene_.materials.size()));
    }
    FP_RETURN_IF_ERROR(DecodeTextures());
    for (PreparedMaterial& material : materials_) SimplifyMask(material);
    return absl::OkStatus();
  }

  absl::Status AddMaterial(const Material& source, size_t index) {
    const auto fail = [&](const std::string& text) {
      return absl::InvalidArgumentError("material " + std::to_string(index) + " ('" + source.name +
                                        "'): " + text);
    };
    PreparedMaterial m{};
    if (!InRange(source.base_color, 1)) return fail("base colour outside of [0, 1]; clamp it");
    if (!(source.base_alpha >= 0 && source.base_alpha <= 1)) {
      return fail("alpha outside of [0, 1]; clamp it");
    }
    if (!InRange(source.emission, kMaxRadiance)) {
      return fail("emission outside of [0, 1e15] W/(m² sr); lower it");
    }
    const bool mask = source.alpha_mode == AlphaMode::kMask;
    if (mask && !(source.alpha_cutoff >= 0 && source.alpha_cutoff <= 1e6f)) {
      return fail("alpha cut-off outside of [0, 1e6]; correct it");
    }
    m.base_color = source.base_color;
    m.base_alpha = source.base_alpha;
    m.alpha_cutoff = mask ? source.alpha_cutoff : -1.0f;
    m.emission = source.emission;
    m.base_color_texture = m.emission_texture = -1;
    m.metal_roughness_texture = m.normal_texture = -1;
    MakeUvMatrix({}, m.base_color_uv);
    MakeUvMatrix({}, m.emission_uv);
    MakeUvMatrix({}, m.metal_roughness_uv);
    MakeUvMatrix({}, m.normal_uv);
    // A texture that is multiplied by black is not looked up.
    if (mask || MaxComponent(m.base_color) > 0) {
      FP_RETURN_IF_ERROR(AddTexture(source.base_color_texture, fail, m.base_color_texture,
                                    m.base_color_uv_set, m.base_color_uv));
    }
    if (MaxComponent(m.emission) > 0) {
      FP_RETURN_IF_ERROR(AddTexture(source.emission_texture, fail, m.emission_texture,
                                    m.emission_uv_set, m.emission_uv));
    }
    if (options_.gloss) FP_RETURN_IF_ERROR(AddGloss(source, fail, m));
    materials_.push_back(m);
    return absl::OkStatus();
  }

  template <typename Fail>
  absl::Status AddGloss(const Material& source, const Fail& fail, PreparedMaterial& m) {
    const auto is_share = [](float x) { return x >= 0 && x <= 1; };
    if (!is_share(source.metallic) || !is_share(source.roughness)) {
      return fail("metallic or roughness outside of [0, 1]; clamp it");
    }
    if (!(source.dielectric_f0 >= 0 && source.dielectric_f0 < 1)) {
      return fail("reflectance at normal incidence outside of [0, 1); correct it");
    }
    if (!(std::fabs(source.normal_scale) <= kMaxUvFactor)) {
      return fail("normal scale beyond 1e10; correct it");
    }
    if (source.metallic > 0 || source.roughness < 1 || source.metal_roughness_texture.present()) {
      m.glossy = 1;
      m.metallic = source.metallic;
      m.roughness = source.roughness;
      m.dielectric_f0 = source.dielectric_f0;
      FP_RETURN_IF_ERROR(AddTexture(source.metal_roughness_texture, fail, m.metal_roughness_texture,
                                    m.metal_roughness_uv_set, m.metal_roughness_uv));
    }
    m.normal_scale = source.normal_scale;
    return AddTexture(source.normal_texture, fail, m.normal_texture, m.normal_uv_set, m.normal_uv);
  }

  // Rows of uv' = offset + R(-rotation) scale uv. The extension's text and its conformance model
  // (TextureTransformTest) turn the image clockwise for a positive rotation, v pointing down.
  static void MakeUvMatrix(const UvTransform& t, float (&m)[6]) {
    const SinCos r = DetSinCos(t.rotation_rad);
    const auto s = static_cast<float>(r.sin);
    const auto c = static_cast<float>(r.cos);
    const float rows[6] = {c * t.scale.x,  s * t.scale.y, t.offset.x,
                           -s * t.scale.x, c * t.scale.y, t.offset.y};
    std::copy(rows, rows + 6, m);
  }

  template <typename Fail>
  absl::Status AddTexture(const TextureRef& ref, const Fail& fail, int32_t& texture,
                          uint32_t& uv_set, float (&uv_matrix)[6]) {
    if (!ref.present()) return absl::OkStatus();
    if (ref.texture >= static_cast<int64_t>(scene_.textures.size())) {
      return fail("texture " + std::to_string(ref.texture) + " does not exist; there are " +
                  std::to_string(scene_.textures.size()));
    }
    if (ref.uv_set > 1)
      return fail("texture coordinate set " + std::to_string(ref.uv_set) + "; only 0 and 1 exist");
    MakeUvMatrix(ref.transform, uv_matrix);
    for (const float f : uv_matrix) {
      if (!(std::fabs(f) <= kMaxUvFactor)) return fail("texture transform beyond 1e10; correct it");
    }
    int32_t& prepared = prepared_texture_[static_cast<size_t>(ref.texture)];
    if (prepared < 0) {
      prepared = static_cast<int32_t>(source_textures_.size());
      source_textures_.push_back(static_cast<size_t>(ref.texture));
    }
    texture = prepared;
    uv_set = ref.uv_set;
    uses_uv_[uv_set] = true;
    return absl::OkStatus();
  }

  absl::Status DecodeTextures() {
    // Textures that differ only in their sampler share their texels.
    std::map<const std::byte*, size_t> image_of_bytes;
    std::vector<size_t> image_of_texture;
    std::vector<const Texture*> images;
    for (const size_t t : source_textures_) {
      const Texture& source = scene_.textures[t];
      const auto [it, is_new] =
          image_of_bytes.try_emplace(source.encoded.bytes().data(), images.size());
      if (is_new) images.push_back(&source);
      image_of_texture.push_back(it->second);
    }
    // Small files can hold large images: all sizes are added up before anything is decoded.
    std::vector<uint64_t> first_texel;
    uint64_t total = 0;
    for (const Texture* image : images) {
      FP_ASSIGN_OR_RETURN(const ImageSize size, ReadImageSize(image->name, image->encoded.bytes()));
      first_texel.push_back(total);
      total += uint64_t{size.width} * size.height;
    }
    if (total > kMaxTexels) {
      return absl::ResourceExhaustedError("the textures have " + std::to_string(total) +
                                          " texels, more than 2^30; make them smaller");
    }
    std::vector<absl::StatusOr<DecodedImage>> decoded(images.size(), absl::UnknownError(""));
    executor_.ForEach(images.size(), 1, [&](size_t i) {
      const FpTrapPause pause;
      decoded[i] = DecodeImage(images[i]->name, images[i]->encoded.bytes());
    });
    skipped_textures_ = scene_.textures.size() - images.size();
    if (options_.all_textures) DecodeForNothing();
    texels_.reserve(total);
    for (const auto& image : decoded) {
      if (!image.ok()) return image.status();
      texels_.insert(texels_.end(), image->texels.begin(), image->texels.end());
    }
    for (size_t t = 0; t < source_textures_.size(); ++t) {
      const Texture& source = scene_.textures[source_textures_[t]];
      const size_t i = image_of_texture[t];
      textures_.push_back({first_texel[i], decoded[i]->width, decoded[i]->height,
                           static_cast<uint32_t>(source.wrap_s),
                           static_cast<uint32_t>(source.wrap_t), source.nearest ? 1u : 0u, 0});
    }
    return absl::OkStatus();
  }

  // Textures that no surface shows may be damaged or too large: nobody asked for them.
  void DecodeForNothing() {
    skipped_textures_ = 0;
    executor_.ForEach(scene_.textures.size(), 1, [&](size_t t) {
      if (prepared_texture_[t] >= 0) return;
      const Texture& texture = scene_.textures[t];
      const FpTrapPause pause;
      const auto size = ReadImageSize(texture.name, texture.encoded.bytes());
      if (!size.ok() || uint64_t{size->width} * size->height > kMaxTexels) return;
      (void)DecodeImage(texture.name, texture.encoded.bytes());
    });
  }

  // A mask without holes is opaque, and rays need not ask for its alpha.
  void SimplifyMask(PreparedMaterial& material) const {
    if (material.alpha_cutoff < 0) return;
    uint32_t least = 255;
    if (material.base_color_texture >= 0) {
      const PreparedTexture& t = textures_[static_cast<size_t>(material.base_color_texture)];
      const uint64_t count = uint64_t{t.width} * t.height;
      for (uint64_t i = 0; i < count; ++i)
        least = std::min(least, texels_[t.first_texel + i] >> 24);
    }
    // The margin covers the rounding of the interpolation.
    const float alpha = material.base_alpha * (static_cast<float>(least) / 255.0f);
    if (alpha * (1.0f - 0x1p-16f) >= material.alpha_cutoff) material.alpha_cutoff = -1.0f;
  }

  // --- Geometry ---

  absl::Status Flatten(size_t instance_index) {
    const Instance& instance = scene_.instances[instance_index];
    const Mesh& mesh = MeshOf(instance);
    if (mesh.triangles.empty()) return absl::OkStatus();
    const size_t first_vertex = vertices_.size();
    const size_t first_triangle = triangles_.size();
    AppendVertices(instance, mesh);
    const bool mirrored = NormalizedLinear(instance.world_from_mesh).Determinant() < 0;
    const auto object = static_cast<uint32_t>(objects_.size());
    for (const auto& t : mesh.triangles) {
      PreparedTriangle triangle{{static_cast<uint32_t>(first_vertex + t[0]),
                                 static_cast<uint32_t>(first_vertex + t[mirrored ? 2 : 1]),
                                 static_cast<uint32_t>(first_vertex + t[mirrored ? 1 : 2])},
                                object};
      const auto& v = triangle.vertex;
      if (IsDegenerate(vertices_[v[0]], vertices_[v[1]], vertices_[v[2]], min_area_)) {
        ++dropped_;
      } else {
        triangles_.push_back(triangle);
      }
    }
    if (triangles_.size() == first_triangle) {
      vertices_.resize(first_vertex);
      return absl::OkStatus();
    }
    AppendNormals(instance, mesh, first_vertex, first_triangle);
    for (size_t set = 0; set < 2; ++set) {
      if (uses_uv_[set]) AppendUvs(mesh, set, first_vertex);
    }
    uint64_t& geometry_key = geometry_keys_.try_emplace(instance.mesh, 0).first->second;
    if (geometry_key == 0) geometry_key = GeometryKey(mesh, used_vertices_[instance.mesh]);
    const uint32_t material = mesh.material < 0
                                  ? default_material_
                                  : prepared_material_[static_cast<size_t>(mesh.material)];
    objects_.push_back({first_triangle, triangles_.size() - first_triangle, material,
                        mesh.normals.empty() ? 0u : 1u,
                        ContentKey(geometry_key, instance.world_from_mesh)});
    object_instances_.push_back(static_cast<uint32_t>(instance_index));
    return absl::OkStatus();
  }

  // Runs body(begin, end) over [0, count), in parallel where that is worth its while.
  template <typename Body>
  void ForPieces(size_t count, const Body& body) {
    if (count <= kPiece)
      body(size_t{0}, count);
    else
      executor_.ForEachPiece(count, kPiece, body);
  }

  void AppendVertices(const Instance& instance, const Mesh& mesh) {
    const size_t first = vertices_.size();
    vertices_.resize(first + mesh.positions.size());
    const auto& used = used_vertices_[instance.mesh];
    ForPieces(mesh.positions.size(), [&](size_t begin, size_t end) {
      for (size_t v = begin; v < end; ++v) {
        if (!used[v]) continue;
        vertices_[first + v] =
            Vec3f(instance.world_from_mesh.Point(Vec3d(mesh.positions[v])) - origin_);
      }
    });
  }

  void AppendNormals(const Instance& instance, const Mesh& mesh, size_t first_vertex,
                     size_t first_triangle) {
    normals_.resize(first_vertex + mesh.positions.size());
    if (mesh.normals.empty()) return;
    const Affine linear = NormalizedLinear(instance.world_from_mesh);
    ForPieces(mesh.normals.size(), [&](size_t begin, size_t end) {
      for (size_t v = begin; v < end; ++v) {
        const Vec3d n(mesh.normals[v]);
        // Normalised first: the cofactors of a tiny normal could vanish.
        const Vec3d unit = IsFinite(n) ? NormalizeOr(n, Vec3d()) : Vec3d();
        normals_[first_vertex + v] = Vec3f(NormalizeOr(linear.Normal(unit), Vec3d()));
      }
    });
    // Made up where the file has none: the area-weighted mean of the triangles around the vertex.
    std::map<uint32_t, Vec3d> missing;
    for (size_t t = first_triangle; t < triangles_.size(); ++t) {
      const auto& v = triangles_[t].vertex;
      for (const uint32_t corner : v) {
        if (normals_[corner] == Vec3f()) {
          missing[corner] += CrossOf(vertices_[v[0]], vertices_[v[1]], vertices_[v[2]]);
        }
      }
    }
    if (missing.empty()) return;
    for (size_t t = first_triangle; t < triangles_.size(); ++t) {
      const auto& v = triangles_[t].vertex;
      for (const uint32_t corner : v) {
        if (normals_[corner] != Vec3f()) continue;
        const Vec3d cross = CrossOf(vertices_[v[0]], vertices_[v[1]], vertices_[v[2]]);
        normals_[corner] = Vec3f(NormalizeOr(missing[corner], NormalizeOr(cross, Vec3d(0, 1, 0))));
      }
    }
  }

  void AppendUvs(const Mesh& mesh, size_t set, size_t first_vertex) {
    uv_[set].resize(first_vertex + mesh.positions.size());
    for (size_t v = 0; v < mesh.uv[set].size(); ++v) {
      const Vec2f& uv = mesh.uv[set][v];
      if (std::isfinite(uv.x) && std::isfinite(uv.y)) uv_[set][first_vertex + v] = uv;
    }
  }

  // --- Lights ---

  absl::Status BuildLights() {
    if (!InRange(scene_.environment.sky, kMaxRadiance)) {
      return absl::InvalidArgumentError("the sky's radiance is outside of [0, 1e15]; correct it");
    }
    for (size_t l = 0; l < scene_.lights.size(); ++l) {
      const PunctualLight& source = scene_.lights[l];
      const auto fail = [&](const std::string& text) {
        return absl::InvalidArgumentError("light " + std::to_string(l) + " ('" + source.name +
                                          "'): " + text);
      };
      PreparedLight light{};
      light.kind = static_cast<uint32_t>(source.kind);
      light.intensity = source.intensity;
      if (!InRange(source.intensity, 1e30f)) {
        return fail("intensity outside of [0, 1e30]; correct it");
      }
      if (source.kind != PunctualKind::kDirectional) {
        const Vec3d offset = source.position - origin_;
        if (!IsFinite(offset) || MaxAbs(offset) > kMaxExtentM) {
          return fail("is more than 2^60 m away from the scene; move it closer");
        }
        light.position = Vec3f(offset);
      }
      if (source.kind != PunctualKind::kPoint) {
        const Vec3d direction =
            IsFinite(source.direction) ? NormalizeOr(source.direction, Vec3d()) : Vec3d();
        if (direction == Vec3d()) return fail("has no direction; give it one");
        light.direction = Vec3f(direction);
      }
      if (!(source.range_m >= 0)) return fail("its range is negative; correct it");
      // A range beyond all that the scene can hold is infinite.
      light.range_m = source.range_m > kMaxExtentM ? 0.0f : static_cast<float>(source.range_m);
      if (source.kind == PunctualKind::kSpot) {
        if (!(source.inner_cone_rad >= 0 && source.inner_cone_rad <= source.outer_cone_rad &&
              source.outer_cone_rad <= 0.5 * kPi + 1e-6)) {
          return fail("cone angles must be 0 <= inner <= outer <= pi/2; correct them");
        }
        light.cos_inner = static_cast<float>(DetSinCos(source.inner_cone_rad).cos);
        light.cos_outer = static_cast<float>(DetSinCos(source.outer_cone_rad).cos);
      } else {
        light.cos_inner = 1;
        light.cos_outer = -1;
      }
      lights_.push_back(light);
    }
    return absl::OkStatus();
  }

  absl::Status BuildEnvironment() {
    const Environment& source = scene_.environment;
    const auto fail = [](const std::string& text) {
      return absl::InvalidArgumentError("environment: " + text);
    };
    if (!InRange(source.sky, kMaxRadiance)) {
      return fail("the sky's radiance is outside of [0, 1e15] W/(m² sr); correct it");
    }
    sky_ = source.sky;
    if (source.map.empty()) return absl::OkStatus();
    const uint64_t count = uint64_t{source.map_width} * source.map_height;
    if (source.map_width == 0 || source.map_height == 0 || count != source.map.size()) {
      return fail("the map has " + std::to_string(source.map.size()) + " texels for " +
                  std::to_string(source.map_width) + " x " + std::to_string(source.map_height));
    }
    if (count > kMaxMapTexels) {
      return absl::ResourceExhaustedError("environment: the map has " + std::to_string(count) +
                                          " texels, more than 2^26; make it smaller");
    }
    if (!IsRotation(source.world_from_map)) {
      return fail("the map's axes are not orthonormal and right-handed; correct its orientation");
    }
    bool constant = true, halves = true;
    for (size_t i = 0; i < source.map.size(); ++i) {
      const Rgb& texel = source.map[i];
      if (!InRange(texel, kMaxRadiance)) {
        return fail("texel (" + std::to_string(i % source.map_width) + ", " +
                    std::to_string(i / source.map_width) +
                    ") of the map is outside of [0, 1e15] W/(m² sr); correct it");
      }
      constant = constant && texel == source.map[0];
      halves = halves && IsHalf(texel.x) && IsHalf(texel.y) && IsHalf(texel.z);
    }
    if (constant) {
      sky_ += source.map[0];
      return InRange(sky_, kMaxRadiance)
                 ? absl::OkStatus()
                 : fail("sky and map together exceed 1e15 W/(m² sr); lower them");
    }
    map_width_ = source.map_width;
    map_height_ = source.map_height;
    world_from_map_ = source.world_from_map;
    // Halves where they lose nothing, as in maps that were stored so.
    for (const Rgb& texel : source.map) {
      for (int c = 0; c < 3; ++c) {
        if (halves) {
          map_halves_.push_back(FloatToHalf(texel[c]));
        } else {
          map_floats_.push_back(texel[c]);
        }
      }
    }
    return absl::OkStatus();
  }

  Blob Serialize() {
    ByteWriter w;
    w.Put(kMagic);
    w.Put(kVersion);
    w.Put(uint32_t{0});
    w.Put(origin_);
    w.Put(sky_);
    w.Put(map_width_);
    w.Put(map_height_);
    w.Put(world_from_map_);
    w.Put(dropped_);
    w.PutArray(std::span<const Vec3f>(vertices_));
    w.PutArray(std::span<const Vec3f>(normals_));
    for (const auto& uv : uv_) w.PutArray(std::span<const Vec2f>(uv));
    w.PutArray(std::span<const PreparedTriangle>(triangles_));
    w.PutArray(std::span<const PreparedObject>(objects_));
    w.PutArray(std::span<const PreparedMaterial>(materials_));
    w.PutArray(std::span<const PreparedTexture>(textures_));
    w.PutArray(std::span<const PreparedLight>(lights_));
    w.PutArray(std::span<const uint32_t>(texels_));
    w.PutArray(std::span<const uint16_t>(map_halves_));
    w.PutArray(std::span<const float>(map_floats_));
    return w.TakeBlob();
  }

  const Scene& scene_;
  Executor& executor_;
  std::vector<std::vector<bool>> used_vertices_;  // by mesh
  std::map<uint32_t, uint64_t> geometry_keys_;    // by mesh
  Vec3d origin_;
  double min_area_ = 0;
  std::vector<uint32_t> prepared_material_;  // by scene material
  std::vector<int32_t> prepared_texture_;    // by scene texture; -1: unused
  std::vector<size_t> source_textures_;      // by prepared texture
  uint32_t default_material_ = 0;
  std::array<bool, 2> uses_uv_{};
  uint64_t dropped_ = 0;
  std::vector<Vec3f> vertices_, normals_;
  std::array<std::vector<Vec2f>, 2> uv_;
  std::vector<PreparedTriangle> triangles_;
  std::vector<PreparedObject> objects_;
  std::vector<uint32_t> object_instances_;
  std::vector<PreparedMaterial> materials_;
  const PrepareOptions options_;
  uint64_t skipped_textures_ = 0;
  std::vector<PreparedTexture> textures_;
  std::vector<uint32_t> texels_;
  std::vector<PreparedLight> lights_;
  Rgb sky_;
  uint32_t map_width_ = 0, map_height_ = 0;
  std::array<Vec3d, 3> world_from_map_ = Environment().world_from_map;
  std::vector<uint16_t> map_halves_;
  std::vector<float> map_floats_;
};

}  // namespace

absl::StatusOr<std::shared_ptr<const PreparedScene>> PreparedScene::Prepare(
    const Scene& scene, Executor& executor, const PrepareOptions& options) {
  Builder builder(scene, executor, options);
  FP_ASSIGN_OR_RETURN(Blob blob, builder.Build());
  return Make(std::move(blob), builder.TakeObjectInstances(), builder.skipped_textures());
}

absl::StatusOr<std::shared_ptr<const PreparedScene>> PreparedScene::FromBlob(Blob blob) {
  return Make(std::move(blob), {}, 0);
}

absl::StatusOr<std::shared_ptr<const PreparedScene>> PreparedScene::Make(
    Blob blob, std::vector<uint32_t> object_instances, uint64_t skipped_textures) {
  std::shared_ptr<PreparedScene> scene(new PreparedScene());
  scene->blob_ = std::move(blob);
  scene->object_instances_ = std::move(object_instances);
  scene->skipped_textures_ = skipped_textures;
  if (const absl::Status status = scene->Read(); !status.ok()) {
    return Annotate(status, "prepared scene");
  }
  FP_RETURN_IF_ERROR(scene->CheckTables());
  FP_RETURN_IF_ERROR(scene->CheckGeometry());
  return std::shared_ptr<const PreparedScene>(std::move(scene));
}

absl::Status PreparedScene::Read() {
  ByteReader r(blob_.bytes());
  uint64_t magic = 0;
  uint32_t version = 0, reserved = 0;
  FP_RETURN_IF_ERROR(r.Get(magic, "magic"));
  if (magic != kMagic) return absl::DataLossError("byte 0: this is not a prepared scene");
  FP_RETURN_IF_ERROR(r.Get(version, "version"));
  if (version != kVersion) {
    return absl::FailedPreconditionError("byte 8: has format version " + std::to_string(version) +
                                         ", this program reads " + std::to_string(kVersion) +
                                         "; run the same farpoint version everywhere");
  }
  FP_RETURN_IF_ERROR(r.Get(reserved, "reserved"));
  FP_RETURN_IF_ERROR(r.Get(origin_, "origin"));
  FP_RETURN_IF_ERROR(r.Get(sky_, "sky"));
  FP_RETURN_IF_ERROR(r.Get(map_width_, "map_width"));
  FP_RETURN_IF_ERROR(r.Get(map_height_, "map_height"));
  FP_RETURN_IF_ERROR(r.Get(world_from_map_, "world_from_map"));
  FP_RETURN_IF_ERROR(r.Get(dropped_triangles_, "dropped_triangles"));
  FP_RETURN_IF_ERROR(r.GetArray(vertices_, "vertices"));
  FP_RETURN_IF_ERROR(r.GetArray(normals_, "normals"));
  FP_RETURN_IF_ERROR(r.GetArray(uv_[0], "uv0"));
  FP_RETURN_IF_ERROR(r.GetArray(uv_[1], "uv1"));
  FP_RETURN_IF_ERROR(r.GetArray(triangles_, "triangles"));
  FP_RETURN_IF_ERROR(r.GetArray(objects_, "objects"));
  FP_RETURN_IF_ERROR(r.GetArray(materials_, "materials"));
  FP_RETURN_IF_ERROR(r.GetArray(textures_, "textures"));
  FP_RETURN_IF_ERROR(r.GetArray(lights_, "lights"));
  FP_RETURN_IF_ERROR(r.GetArray(texels_, "texels"));
  FP_RETURN_IF_ERROR(r.GetArray(map_halves_, "map_halves"));
  FP_RETURN_IF_ERROR(r.GetArray(map_floats_, "map_floats"));
  return r.ExpectEnd();
}

absl::Status PreparedScene::CheckTables() const {
  if (!IsFinite(origin_) || MaxAbs(origin_) > kMaxOriginM) {
    return BadBlob("the origin is out of range");
  }
  if (!InRange(sky_, kMaxRadiance)) return BadBlob("the sky's radiance is out of range");
  const uint64_t map_texels = uint64_t{map_width_} * map_height_;
  if ((map_width_ == 0) != (map_height_ == 0) || map_texels > kMaxMapTexels ||
      map_halves_.size() + map_floats_.size() != 3 * map_texels ||
      (!map_halves_.empty() && !map_floats_.empty()) || !IsRotation(world_from_map_)) {
    return BadBlob("the environment map has a value out of range");
  }
  for (uint32_t y = 0; y < map_height_; ++y) {
    for (uint32_t x = 0; x < map_width_; ++x) {
      if (!InRange(MapTexel(x, y), kMaxRadiance)) {
        return BadBlob("texel (" + std::to_string(x) + ", " + std::to_string(y) +
                       ") of the environment map is out of range");
      }
    }
  }
  if (normals_.size() != vertices_.size() || vertices_.size() > kMaxElements ||
      triangles_.size() > kMaxElements) {
    return BadBlob("the numbers of vertices, normals and triangles do not fit");
  }
  for (const auto& uv : uv_) {
    if (!uv.empty() && uv.size() != vertices_.size()) {
      return BadBlob("the numbers of vertices and texture coordinates do not fit");
    }
  }
  for (size_t t = 0; t < textures_.size(); ++t) {
    const PreparedTexture& texture = textures_[t];
    const std::string name = "texture " + std::to_string(t);
    if (texture.width == 0 || texture.height == 0 || texture.width > kMaxImageSide ||
        texture.height > kMaxImageSide || texture.wrap_s > 2 || texture.wrap_t > 2 ||
        texture.nearest > 1) {
      return BadBlob(name + " has a value out of range");
    }
    const uint64_t count = uint64_t{texture.width} * texture.height;
    if (texture.first_texel > texels_.size() || count > texels_.size() - texture.first_texel) {
      return BadBlob(name + " reaches beyond the texels");
    }
  }
  for (size_t m = 0; m < materials_.size(); ++m) {
    const PreparedMaterial& material = materials_[m];
    bool good = InRange(material.base_color, 1) && InRange(material.emission, kMaxRadiance) &&
                material.base_alpha >= 0 && material.base_alpha <= 1 &&
                material.alpha_cutoff >= -1 && material.alpha_cutoff <= 1e6f;
    for (int i = 0; i < 6; ++i) {
      good = good && std::fabs(material.base_color_uv[i]) <= kMaxUvFactor &&
             std::fabs(material.emission_uv[i]) <= kMaxUvFactor &&
             std::fabs(material.metal_roughness_uv[i]) <= kMaxUvFactor &&
             std::fabs(material.normal_uv[i]) <= kMaxUvFactor;
    }
    const auto texture_is_good = [&](int32_t texture, uint32_t uv_set) {
      if (texture == -1) return uv_set <= 1;
      return texture >= 0 && static_cast<size_t>(texture) < textures_.size() && uv_set <= 1 &&
             uv_[uv_set].size() == vertices_.size();
    };
    good = good && texture_is_good(material.base_color_texture, material.base_color_uv_set) &&
           texture_is_good(material.emission_texture, material.emission_uv_set) &&
           texture_is_good(material.metal_roughness_texture, material.metal_roughness_uv_set) &&
           texture_is_good(material.normal_texture, material.normal_uv_set);
    good = good && material.glossy <= 1 && material.metallic >= 0 && material.metallic <= 1 &&
           material.roughness >= 0 && material.roughness <= 1 && material.dielectric_f0 >= 0 &&
           material.dielectric_f0 < 1 && std::fabs(material.normal_scale) <= kMaxUvFactor;
    if (!good) return BadBlob("material " + std::to_string(m) + " has a value out of range");
  }
  for (size_t l = 0; l < lights_.size(); ++l) {
    const PreparedLight& light = lights_[l];
    const bool directed = light.kind != static_cast<uint32_t>(PunctualKind::kPoint);
    const bool good = light.kind <= 2 && InRange(light.intensity, 1e30f) &&
                      IsFinite(light.position) && MaxAbs(light.position) <= kMaxExtentM &&
                      IsFinite(light.direction) &&
                      (!directed || std::fabs(Length2(light.direction) - 1.0f) < 1e-3f) &&
                      light.range_m >= 0 && light.range_m <= kMaxExtentM && light.cos_inner <= 1 &&
                      light.cos_outer >= -1 && light.cos_outer <= light.cos_inner;
    if (!good) return BadBlob("light " + std::to_string(l) + " has a value out of range");
  }
  return absl::OkStatus();
}

absl::Status PreparedScene::CheckGeometry() {
  for (size_t v = 0; v < vertices_.size(); ++v) {
    if (!IsFinite(vertices_[v]) || !(MaxAbs(vertices_[v]) <= kMaxExtentM)) {
      return BadBlob("vertex " + std::to_string(v) + " is out of range");
    }
  }
  for (const auto& uv : uv_) {
    for (size_t v = 0; v < uv.size(); ++v) {
      if (!std::isfinite(uv[v].x) || !std::isfinite(uv[v].y)) {
        return BadBlob("texture coordinate " + std::to_string(v) + " is not finite");
      }
    }
  }
  uint64_t next = 0;
  for (size_t o = 0; o < objects_.size(); ++o) {
    const PreparedObject& object = objects_[o];
    const std::string name = "object " + std::to_string(o);
    if (object.first_triangle != next || object.triangle_count == 0 ||
        object.triangle_count > triangles_.size() - next || object.material >= materials_.size() ||
        object.has_normals > 1) {
      return BadBlob(name + " has a value out of range");
    }
    next += object.triangle_count;
    const PreparedMaterial& material = materials_[object.material];
    const bool emits = MaxComponent(material.emission) > 0;
    has_alpha_masks_ = has_alpha_masks_ || material.alpha_cutoff >= 0;
    has_gloss_ = has_gloss_ || material.glossy != 0;
    has_normal_maps_ = has_normal_maps_ || material.normal_texture >= 0;
    for (uint64_t t = object.first_triangle; t < next; ++t) {
      const PreparedTriangle& triangle = triangles_[t];
      bool good = triangle.object == o;
      for (const uint32_t v : triangle.vertex) {
        good = good && v < vertices_.size();
        if (!good) break;
        // Written so that NaN fails.
        good = object.has_normals == 0 || std::fabs(Length2(normals_[v]) - 1.0f) < 1e-3f;
        bounds_.Extend(vertices_[v]);
      }
      good =
          good && !IsDegenerate(vertices_[triangle.vertex[0]], vertices_[triangle.vertex[1]],
                                vertices_[triangle.vertex[2]], std::numeric_limits<float>::min());
      if (!good) return BadBlob("triangle " + std::to_string(t) + " has a value out of range");
      if (emits) emissive_triangles_.push_back(static_cast<uint32_t>(t));
    }
  }
  if (next != triangles_.size()) return BadBlob("triangles belong to no object");
  diagonal_m_ = bounds_.Diagonal();
  return absl::OkStatus();
}

Vec3f PreparedScene::GeometricNormal(uint32_t triangle) const {
  const auto& v = triangles_[triangle].vertex;
  const Vec3d cross = CrossOf(vertices_[v[0]], vertices_[v[1]], vertices_[v[2]]);
  return Vec3f(NormalizeOr(cross, Vec3d(0, 1, 0)));
}

float PreparedScene::TriangleArea(uint32_t triangle) const {
  const auto& v = triangles_[triangle].vertex;
  return static_cast<float>(0.5 *
                            Length(CrossOf(vertices_[v[0]], vertices_[v[1]], vertices_[v[2]])));
}

Vec3f PreparedScene::PointOn(uint32_t triangle, float b1, float b2) const {
  const auto& v = triangles_[triangle].vertex;
  const Vec3f& a = vertices_[v[0]];
  return a + (vertices_[v[1]] - a) * b1 + (vertices_[v[2]] - a) * b2;
}

Vec3f PreparedScene::ShadingNormal(uint32_t triangle, float b1, float b2,
                                   const Vec3f& n_geometric) const {
  const PreparedTriangle& t = triangles_[triangle];
  const bool bumped = has_normal_maps_ && MaterialOf(triangle).normal_texture >= 0;
  if (objects_[t.object].has_normals == 0) {
    return bumped ? Bumped(triangle, b1, b2, n_geometric, n_geometric) : n_geometric;
  }
  const Vec3f sum = normals_[t.vertex[0]] * (1.0f - b1 - b2) + normals_[t.vertex[1]] * b1 +
                    normals_[t.vertex[2]] * b2;
  const Vec3f n = NormalizeOr(sum, n_geometric);
  const Vec3f towards = Dot(n, n_geometric) < 0 ? -n : n;
  return bumped ? Bumped(triangle, b1, b2, towards, n_geometric) : towards;
}

Vec3f PreparedScene::Bumped(uint32_t triangle, float b1, float b2, const Vec3f& n,
                            const Vec3f& ng) const {
  const PreparedMaterial& m = MaterialOf(triangle);
  const auto& v = triangles_[triangle].vertex;
  const auto uv = CornerUvs(triangle, m.normal_uv_set, m.normal_uv);
  const Vec3d e1 = Vec3d(vertices_[v[1]]) - Vec3d(vertices_[v[0]]);
  const Vec3d e2 = Vec3d(vertices_[v[2]]) - Vec3d(vertices_[v[0]]);
  const double u1 = double{uv[1].x} - double{uv[0].x}, v1 = double{uv[1].y} - double{uv[0].y};
  const double u2 = double{uv[2].x} - double{uv[0].x}, v2 = double{uv[2].y} - double{uv[0].y};
  const double determinant = u1 * v2 - u2 * v1;
  if (!(std::fabs(determinant) > 0)) return n;
  // dP/du and dP/dv, but for a positive factor.
  const double sign = determinant > 0 ? 1 : -1;
  const Vec3d along_u = (e1 * v2 - e2 * v1) * sign, along_v = (e2 * u1 - e1 * u2) * sign;
  const Vec3d z(n);
  const Vec3d x = NormalizeOr(along_u - z * Dot(z, along_u), Vec3d());
  if (x == Vec3d()) return n;
  Vec3d y = Cross(z, x);
  if (Dot(y, along_v) > 0) y = -y;
  const Rgb texel = SampleLinear(m.normal_texture,
                                 TransformUv(m.normal_uv, UvAt(triangle, b1, b2, m.normal_uv_set)));
  const double scale = double{m.normal_scale};
  const Vec3d local{(2 * double{texel.x} - 1) * scale, (2 * double{texel.y} - 1) * scale,
                    2 * double{texel.z} - 1};
  const Vec3f turned(NormalizeOr(x * local.x + y * local.y + z * local.z, z));
  const float cosine = Dot(turned, ng);
  if (cosine >= kLeastBumpCosine) return turned;
  return NormalizeOr(turned + ng * (kLeastBumpCosine - cosine), ng);
}

Vec2f PreparedScene::UvAt(uint32_t triangle, float b1, float b2, uint32_t set) const {
  const auto& vertex = triangles_[triangle].vertex;
  const auto& uv = uv_[set];
  const Vec2f &a = uv[vertex[0]], &b = uv[vertex[1]], &c = uv[vertex[2]];
  return {a.x + (b.x - a.x) * b1 + (c.x - a.x) * b2, a.y + (b.y - a.y) * b1 + (c.y - a.y) * b2};
}

Rgb PreparedScene::SampleLinear(int32_t texture, const Vec2f& uv) const {
  const PreparedTexture& t = textures_[static_cast<size_t>(texture)];
  const uint32_t* texels = texels_.data() + t.first_texel;
  const auto wrap_s = static_cast<WrapMode>(t.wrap_s);
  const auto wrap_t = static_cast<WrapMode>(t.wrap_t);
  const auto value = [&](uint32_t x, uint32_t y) {
    const uint32_t texel = texels[size_t{y} * t.width + x];
    return Rgb(static_cast<float>(texel & 255), static_cast<float>(texel >> 8 & 255),
               static_cast<float>(texel >> 16 & 255)) *
           (1.0f / 255);
  };
  if (t.nearest != 0) {
    return value(NearestTexel(uv.x, t.width, wrap_s), NearestTexel(uv.y, t.height, wrap_t));
  }
  const Tap x = LinearTap(uv.x, t.width, wrap_s), y = LinearTap(uv.y, t.height, wrap_t);
  const Rgb upper =
      value(x.first, y.first) * (1.0f - x.weight) + value(x.second, y.first) * x.weight;
  const Rgb lower =
      value(x.first, y.second) * (1.0f - x.weight) + value(x.second, y.second) * x.weight;
  return upper * (1.0f - y.weight) + lower * y.weight;
}

Rgb PreparedScene::SampleTexture(int32_t texture, const Vec2f& uv, float* alpha) const {
  const PreparedTexture& t = textures_[static_cast<size_t>(texture)];
  const uint32_t* texels = texels_.data() + t.first_texel;
  const auto wrap_s = static_cast<WrapMode>(t.wrap_s);
  const auto wrap_t = static_cast<WrapMode>(t.wrap_t);
  if (t.nearest != 0) {
    const uint32_t texel = texels[size_t{NearestTexel(uv.y, t.height, wrap_t)} * t.width +
                                  NearestTexel(uv.x, t.width, wrap_s)];
    if (alpha != nullptr) *alpha = LinearAlpha(texel);
    return LinearColor(texel);
  }
  const Tap x = LinearTap(uv.x, t.width, wrap_s);
  const Tap y = LinearTap(uv.y, t.height, wrap_t);
  const uint32_t* upper = texels + size_t{y.first} * t.width;
  const uint32_t* lower = texels + size_t{y.second} * t.width;
  const uint32_t texel[4] = {upper[x.first], upper[x.second], lower[x.first], lower[x.second]};
  const float weight[4] = {(1.0f - x.weight) * (1.0f - y.weight), x.weight * (1.0f - y.weight),
                           (1.0f - x.weight) * y.weight, x.weight * y.weight};
  if (alpha != nullptr) {
    *alpha = LinearAlpha(texel[0]) * weight[0] + LinearAlpha(texel[1]) * weight[1] +
             LinearAlpha(texel[2]) * weight[2] + LinearAlpha(texel[3]) * weight[3];
  }
  return LinearColor(texel[0]) * weight[0] + LinearColor(texel[1]) * weight[1] +
         LinearColor(texel[2]) * weight[2] + LinearColor(texel[3]) * weight[3];
}

SurfaceSample PreparedScene::BaseSurface(uint32_t triangle, float b1, float b2) const {
  const PreparedTriangle& t = triangles_[triangle];
  const PreparedMaterial& m = materials_[objects_[t.object].material];
  SurfaceSample sample{m.base_color, m.emission, m.alpha_cutoff < 0 ? 1.0f : m.base_alpha};
  if (!UsesTexture(m)) return sample;
  const auto uv_at = [&](uint32_t set) { return UvAt(triangle, b1, b2, set); };
  if (m.base_color_texture >= 0) {
    float alpha = 1;
    const Vec2f uv = TransformUv(m.base_color_uv, uv_at(m.base_color_uv_set));
    const Rgb color = SampleTexture(m.base_color_texture, uv, &alpha);
    // Weights may sum to a rounding error above one.
    sample.albedo = Min(m.base_color * color, Rgb(1));
    if (m.alpha_cutoff >= 0) sample.alpha = std::min(m.base_alpha * alpha, 1.0f);
  }
  if (m.emission_texture >= 0) {
    const Vec2f uv = TransformUv(m.emission_uv, uv_at(m.emission_uv_set));
    sample.emission = m.emission * SampleTexture(m.emission_texture, uv, nullptr);
  }
  return sample;
}

SurfaceSample PreparedScene::Surface(uint32_t triangle, float b1, float b2) const {
  SurfaceSample sample = BaseSurface(triangle, b1, b2);
  if (IsGlossy(triangle)) sample.albedo = MeanReflectance(Glossy(triangle, b1, b2, sample.albedo));
  return sample;
}

MicrofacetMaterial PreparedScene::MicrofacetAt(uint32_t triangle, float b1, float b2) const {
  return Glossy(triangle, b1, b2, BaseSurface(triangle, b1, b2).albedo);
}

MicrofacetMaterial PreparedScene::Glossy(uint32_t triangle, float b1, float b2,
                                         const Rgb& base_color) const {
  const PreparedMaterial& m = MaterialOf(triangle);
  MicrofacetMaterial out{base_color, m.metallic, m.roughness, m.dielectric_f0};
  if (m.metal_roughness_texture >= 0) {
    const Rgb texel = SampleLinear(
        m.metal_roughness_texture,
        TransformUv(m.metal_roughness_uv, UvAt(triangle, b1, b2, m.metal_roughness_uv_set)));
    out.roughness = std::min(m.roughness * texel.y, 1.0f);
    out.metallic = std::min(m.metallic * texel.z, 1.0f);
  }
  return out;
}

std::array<Vec2f, 3> PreparedScene::CornerUvs(uint32_t triangle, uint32_t set,
                                              const float (&m)[6]) const {
  std::array<Vec2f, 3> corner;
  for (size_t i = 0; i < 3; ++i) {
    corner[i] = TransformUv(m, uv_[set][triangles_[triangle].vertex[i]]);
  }
  return corner;
}

// Whether all texels that lookups within the triangle can reach are black. Where that is too much
// to look at, or the triangle reaches beyond the texture's edge, false.
bool PreparedScene::IsBlack(int32_t texture, const std::array<Vec2f, 3>& corner) const {
  constexpr float kMaxSide = 256.0f;
  constexpr float kReach = 0.51f;  // half a texel, and rounding
  const PreparedTexture& t = textures_[static_cast<size_t>(texture)];
  const auto range = [&](float a, float b, float c, uint32_t size, int64_t& first, int64_t& last) {
    const float low = std::floor(std::min({a, b, c}) * static_cast<float>(size) - kReach);
    const float high = std::floor(std::max({a, b, c}) * static_cast<float>(size) + kReach);
    if (!(low >= -2.0f) || !(high <= static_cast<float>(size) + 2.0f) || !(high - low < kMaxSide)) {
      return false;
    }
    first = static_cast<int64_t>(low);
    last = static_cast<int64_t>(high);
    return true;
  };
  int64_t x0 = 0, x1 = 0, y0 = 0, y1 = 0;
  if (!range(corner[0].x, corner[1].x, corner[2].x, t.width, x0, x1) ||
      !range(corner[0].y, corner[1].y, corner[2].y, t.height, y0, y1)) {
    return false;
  }
  // Around the edges, whatever the wrap mode: more than is looked up does no harm.
  const auto wrapped = [](int64_t i, uint32_t size) {
    const auto n = static_cast<int64_t>(size);
    return static_cast<size_t>(((i % n) + n) % n);
  };
  const auto clamped = [](int64_t i, uint32_t size) {
    return static_cast<size_t>(std::clamp<int64_t>(i, 0, static_cast<int64_t>(size) - 1));
  };
  for (int64_t y = y0; y <= y1; ++y) {
    for (int64_t x = x0; x <= x1; ++x) {
      for (const size_t row : {wrapped(y, t.height), clamped(y, t.height)}) {
        for (const size_t column : {wrapped(x, t.width), clamped(x, t.width)}) {
          const uint32_t texel = texels_[t.first_texel + row * t.width + column];
          if ((texel & 0xffffffu) != 0) return false;
        }
      }
    }
  }
  return true;
}

Rgb PreparedScene::MeanEmission(uint32_t triangle) const {
  const PreparedMaterial& m = MaterialOf(triangle);
  if (m.emission_texture < 0 && m.alpha_cutoff < 0) return m.emission;
  double extent_texels = 0;
  const auto look_at = [&](int32_t texture, uint32_t set, const float(&matrix)[6]) {
    if (texture < 0) return std::array<Vec2f, 3>{};
    const std::array<Vec2f, 3> corner = CornerUvs(triangle, set, matrix);
    const PreparedTexture& t = textures_[static_cast<size_t>(texture)];
    for (size_t i = 0; i < 3; ++i) {
      const Vec2f &a = corner[i], &b = corner[(i + 1) % 3];
      extent_texels = std::max({extent_texels, static_cast<double>(std::fabs(a.x - b.x)) * t.width,
                                static_cast<double>(std::fabs(a.y - b.y)) * t.height});
    }
    return corner;
  };
  if (m.emission_texture >= 0 &&
      IsBlack(m.emission_texture, look_at(m.emission_texture, m.emission_uv_set, m.emission_uv))) {
    return {};
  }
  if (m.alpha_cutoff >= 0) look_at(m.base_color_texture, m.base_color_uv_set, m.base_color_uv);
  // Centroids of the cells that n lines parallel to each side cut.
  const int n = extent_texels < 64 ? std::max(4, static_cast<int>(extent_texels)) : 64;
  const float step = 1.0f / static_cast<float>(n);
  Vec3d sum;
  int points = 0;
  for (int i = 0; i < n; ++i) {
    for (int j = 0; i + j < n; ++j, ++points) {
      const float b1 = (static_cast<float>(i) + 1.0f / 3.0f) * step;
      const float b2 = (static_cast<float>(j) + 1.0f / 3.0f) * step;
      const SurfaceSample surface = Surface(triangle, b1, b2);
      if (!(surface.alpha < m.alpha_cutoff)) sum += Vec3d(surface.emission);
    }
  }
  // What the points missed may be there all the same.
  constexpr float kFloor = 1.0f / 1024.0f;
  return Max(Rgb(sum / points), m.emission * kFloor);
}

Rgb PreparedScene::MapAt(double x, double y) const {
  const double fx = std::floor(x - 0.5), fy = std::floor(y - 0.5);
  const auto wx = static_cast<float>(x - 0.5 - fx), wy = static_cast<float>(y - 0.5 - fy);
  const auto column = [&](double i) {
    const double w = static_cast<double>(map_width_);
    return static_cast<uint32_t>(i < 0 ? i + w : i >= w ? i - w : i);
  };
  const auto row = [&](double j) {
    return static_cast<uint32_t>(std::clamp(j, 0.0, static_cast<double>(map_height_) - 1.0));
  };
  const uint32_t x0 = column(fx), x1 = column(fx + 1), y0 = row(fy), y1 = row(fy + 1);
  return (MapTexel(x0, y0) * (1.0f - wx) + MapTexel(x1, y0) * wx) * (1.0f - wy) +
         (MapTexel(x0, y1) * (1.0f - wx) + MapTexel(x1, y1) * wx) * wy;
}

Rgb PreparedScene::EnvironmentRadiance(const Vec3f& w) const {
  if (map_width_ == 0) return sky_;
  const Vec3d d(w);
  const double x = Dot(d, world_from_map_[0]), y = Dot(d, world_from_map_[1]),
               z = Dot(d, world_from_map_[2]);
  const double latitude = DetAtan2(y, std::sqrt(x * x + z * z));
  const double longitude = DetAtan2(x, z);
  const double width = map_width_, height = map_height_;
  return sky_ + MapAt(std::clamp((0.5 - longitude / (2 * kPi)) * width, 0.0, width),
                      std::clamp((0.5 - latitude / kPi) * height, 0.0, height));
}

float PreparedScene::Alpha(uint32_t triangle, float b1, float b2) const {
  if (MaterialOf(triangle).alpha_cutoff < 0) return 1.0f;
  return BaseSurface(triangle, b1, b2).alpha;
}

}  // namespace farpoint
