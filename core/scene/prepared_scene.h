// The prepared scene: what rays and shading need, flattened to world space, as one immutable blob
// that coordinator and workers share by its SHA-256 (byte format: docs/protocol.md).
//
// Positions are float offsets from `origin` (in double: the centre of the world bounding box, or,
// where that is 16 times the size of the box that holds most of the scene, of the latter), so that
// neither a scene far from zero nor one with a few objects far away loses precision. Triangles of
// degenerate area are kept out: what is left has an area and a normal in float. Scaling a scene by
// a power of two scales positions and lengths exactly and leaves all else as it is, bit by bit.
// Immutable, so thread-safe.
#pragma once

#include <array>
#include <cstdint>
#include <memory>
#include <span>
#include <string>
#include <vector>

#include "core/base/blob.h"
#include "core/base/executor.h"
#include "core/base/status.h"
#include "core/math/half.h"
#include "core/math/microfacet.h"
#include "core/scene/scene.h"

namespace farpoint {

// Indices into PreparedScene::vertices().
struct PreparedTriangle {
  std::array<uint32_t, 3> vertex;
  uint32_t object;  // index into objects()
};

// A run of triangles that came from one instance of one mesh.
struct PreparedObject {
  uint64_t first_triangle, triangle_count;
  uint32_t material;
  uint32_t has_normals;  // 1: vertex normals are valid; 0: flat
  uint64_t content_key;  // hash of the mesh's geometry without its power of two and of the
                         // instance's linear transform without its size, to 20 bits: seeds
                         // sampling, unchanged when the object only moves, its peers change or
                         // the scene is scaled
};

struct PreparedMaterial {
  Rgb base_color;
  float alpha_cutoff;  // < 0: opaque
  Rgb emission;
  float base_alpha;
  int32_t base_color_texture;  // -1: none
  int32_t emission_texture;
  uint32_t base_color_uv_set, emission_uv_set;
  float base_color_uv[6];  // rows of the 2x3 matrix on (u, v, 1)
  float emission_uv[6];
  // 1: core/math/microfacet.h; 0: Lambert, what follows up to the normal texture is 0.
  uint32_t glossy;
  float metallic, roughness, dielectric_f0;
  int32_t metal_roughness_texture;  // -1: none
  int32_t normal_texture;
  uint32_t metal_roughness_uv_set, normal_uv_set;
  float metal_roughness_uv[6];
  float normal_uv[6];
  float normal_scale;
  uint32_t reserved;
};

struct PreparedTexture {
  uint64_t first_texel;  // into texels()
  uint32_t width, height;
  uint32_t wrap_s, wrap_t;  // WrapMode
  uint32_t nearest;
  uint32_t reserved;
};

struct PreparedLight {
  uint32_t kind;    // PunctualKind
  Vec3f position;   // relative to origin
  Vec3f direction;  // unit, the way the light travels
  Rgb intensity;
  float range_m;  // 0: infinite
  float cos_inner, cos_outer;
  float reserved;
};

// Alpha and emission aside, what a shading point needs.
struct SurfaceSample {
  Rgb albedo;    // linear; what is glossy: MeanReflectance
  Rgb emission;  // radiance
  float alpha;   // 1 unless the material is a mask
};

struct PrepareOptions {
  // Decodes also the textures that no surface shows, and drops them: the same blob.
  bool all_textures = false;
  // Materials are glTF's metallic-roughness model, with normal maps. Else all are Lambert.
  bool gloss = false;
};

class PreparedScene {
 public:
  // Flattens, decodes the textures that are used, drops degenerate triangles, checks that all is
  // finite. kInvalidArgument names mesh and instance, kResourceExhausted a limit. A scene's extent
  // must lie within 2^-30 and 2^60 m, so that areas and squared distances are normal floats.
  // Mirrored instances keep the front of their faces: their triangles are wound the other way.
  // The front of vertex normals that are zero or not finite is made up from the triangles.
  static absl::StatusOr<std::shared_ptr<const PreparedScene>> Prepare(
      const Scene& scene, Executor& executor, const PrepareOptions& options = {});
  // Reads a blob; every offset and index is checked. kDataLoss says what and where. The blob is
  // kept and viewed in place.
  static absl::StatusOr<std::shared_ptr<const PreparedScene>> FromBlob(Blob blob);

  const Blob& blob() const { return blob_; }

  const Vec3d& origin() const { return origin_; }   // world
  const Box3f& bounds() const { return bounds_; }   // relative to origin
  float diagonal_m() const { return diagonal_m_; }  // of bounds(); 0 if there are no triangles

  std::span<const Vec3f> vertices() const { return vertices_; }  // relative to origin
  // One per vertex: unit, or zero where the object has none (has_normals == 0).
  std::span<const Vec3f> normals() const { return normals_; }
  std::span<const Vec2f> uvs(unsigned set) const { return uv_[set]; }  // empty or one per vertex
  std::span<const PreparedTriangle> triangles() const { return triangles_; }
  std::span<const PreparedObject> objects() const { return objects_; }
  std::span<const PreparedMaterial> materials() const { return materials_; }
  std::span<const PreparedTexture> textures() const { return textures_; }
  std::span<const PreparedLight> lights() const { return lights_; }
  // The constant part of the environment; a map of one colour is a part of it.
  const Rgb& sky() const { return sky_; }
  // The environment map, if it has two colours or more: lat-long, laid out as Environment
  // (scene.h) says, without the sky.
  bool has_environment_map() const { return map_width_ != 0; }
  uint32_t map_width() const { return map_width_; }
  uint32_t map_height() const { return map_height_; }
  const std::array<Vec3d, 3>& world_from_map() const { return world_from_map_; }
  Rgb MapTexel(uint32_t x, uint32_t y) const {
    const size_t at = 3 * (size_t{y} * map_width_ + x);
    if (!map_halves_.empty()) {
      return {HalfToFloat(map_halves_[at]), HalfToFloat(map_halves_[at + 1]),
              HalfToFloat(map_halves_[at + 2])};
    }
    return {map_floats_[at], map_floats_[at + 1], map_floats_[at + 2]};
  }
  // The map at x in [0, map_width()], y in [0, map_height()], where texel (i, j) has its centre at
  // (i + 0.5, j + 0.5): bilinear, around in x, held at the edge in y. There must be a map.
  Rgb MapAt(double x, double y) const;
  // The radiance that arrives from the unit world direction `w` if nothing lies there.
  Rgb EnvironmentRadiance(const Vec3f& w) const;
  // Objects are two-sided; a scene is lit if it has a light with power, an emitter, a sky or a map.
  bool has_alpha_masks() const { return has_alpha_masks_; }
  bool has_gloss() const { return has_gloss_; }  // a surface is glossy
  // Triangles that Prepare left out because they are degenerate.
  uint64_t dropped_triangles() const { return dropped_triangles_; }
  // Textures of the Scene that Prepare did not decode, because no surface shows them or because
  // they are multiplied by black, and images that it decoded once for several textures.
  uint64_t skipped_textures() const { return skipped_textures_; }
  // By object: the index of the instance that it was made of, in the Scene given to Prepare. The
  // vertices of that instance's mesh, in their order, follow those of the object before. Empty if
  // the scene was read from a blob.
  std::span<const uint32_t> object_instances() const { return object_instances_; }
  // Triangles whose material emits (emission > 0 in some channel), ascending.
  std::span<const uint32_t> emissive_triangles() const { return emissive_triangles_; }

  const PreparedMaterial& MaterialOf(uint32_t triangle) const {
    return materials_[objects_[triangles_[triangle].object].material];
  }
  // Unit geometric normal by the winding; area in m². Computed in double, rounded once.
  Vec3f GeometricNormal(uint32_t triangle) const;
  float TriangleArea(uint32_t triangle) const;
  // b1, b2: barycentric weights of vertices 1 and 2.
  Vec3f PointOn(uint32_t triangle, float b1, float b2) const;
  bool IsGlossy(uint32_t triangle) const { return has_gloss_ && MaterialOf(triangle).glossy != 0; }
  // Interpolated and normalised, on the side of the geometric normal; the geometric normal where
  // the mesh has none. Then turned by the material's normal map: its x is the direction in which
  // the texture's u grows on the triangle, its y that in which v falls, both made orthogonal to the
  // normal (so mirrored coordinates mirror the relief); left alone where the coordinates are
  // degenerate, and never turned below the surface.
  Vec3f ShadingNormal(uint32_t triangle, float b1, float b2) const {
    return ShadingNormal(triangle, b1, b2, GeometricNormal(triangle));
  }
  // The same for who has GeometricNormal(triangle) at hand.
  Vec3f ShadingNormal(uint32_t triangle, float b1, float b2, const Vec3f& geometric_normal) const;
  // Textures are looked up bilinearly (or nearest where the file says so), in linear light, on
  // their finest level.
  SurfaceSample Surface(uint32_t triangle, float b1, float b2) const;
  // Precondition: IsGlossy(triangle).
  MicrofacetMaterial MicrofacetAt(uint32_t triangle, float b1, float b2) const;
  float Alpha(uint32_t triangle, float b1, float b2) const;
  // The emission averaged over the triangle, holes being black: exact if it has no texture, else
  // the mean of up to 2,080 points. (0, 0, 0) only if all of the triangle is black.
  Rgb MeanEmission(uint32_t triangle) const;

 private:
  PreparedScene() = default;
  static absl::StatusOr<std::shared_ptr<const PreparedScene>> Make(
      Blob blob, std::vector<uint32_t> object_instances, uint64_t skipped_textures);
  absl::Status Read();
  absl::Status CheckTables() const;
  absl::Status CheckGeometry();
  Rgb SampleTexture(int32_t texture, const Vec2f& uv, float* alpha) const;
  // Without alpha, and as it stands: no sRGB.
  Rgb SampleLinear(int32_t texture, const Vec2f& uv) const;
  Vec2f UvAt(uint32_t triangle, float b1, float b2, uint32_t set) const;
  // As if Lambert.
  SurfaceSample BaseSurface(uint32_t triangle, float b1, float b2) const;
  MicrofacetMaterial Glossy(uint32_t triangle, float b1, float b2, const Rgb& base_color) const;
  Vec3f Bumped(uint32_t triangle, float b1, float b2, const Vec3f& n, const Vec3f& ng) const;
  std::array<Vec2f, 3> CornerUvs(uint32_t triangle, uint32_t set, const float (&m)[6]) const;
  bool IsBlack(int32_t texture, const std::array<Vec2f, 3>& corner) const;

  Blob blob_;
  Vec3d origin_;
  Box3f bounds_;
  float diagonal_m_ = 0;
  std::span<const Vec3f> vertices_, normals_;
  std::array<std::span<const Vec2f>, 2> uv_;
  std::span<const PreparedTriangle> triangles_;
  std::span<const PreparedObject> objects_;
  std::span<const PreparedMaterial> materials_;
  std::span<const PreparedTexture> textures_;
  std::span<const uint32_t> texels_;  // RGBA8, sRGB-encoded colour, linear alpha, R lowest byte
  std::span<const PreparedLight> lights_;
  std::vector<uint32_t> emissive_triangles_;
  std::vector<uint32_t> object_instances_;
  Rgb sky_;
  uint32_t map_width_ = 0, map_height_ = 0;
  std::array<Vec3d, 3> world_from_map_{Vec3d{1, 0, 0}, Vec3d{0, 1, 0}, Vec3d{0, 0, 1}};
  std::span<const uint16_t> map_halves_;  // RGB by texel; one of the two is empty
  std::span<const float> map_floats_;
  bool has_alpha_masks_ = false;
  bool has_gloss_ = false, has_normal_maps_ = false;
  uint64_t dropped_triangles_ = 0;
  uint64_t skipped_textures_ = 0;
};

}  // namespace farpoint
