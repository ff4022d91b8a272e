// The scene as a user describes it, whatever file it came from: meshes, instances, materials,
// textures, lights, cameras. World frame: right-handed, y up (glTF's), metres. Radiance in
// W/(m² sr), irradiance in W/m², both scene-linear Rec. 709. Plain data, no behaviour.
#pragma once

#include <array>
#include <cstdint>
#include <string>
#include <vector>

#include "core/base/blob.h"
#include "core/math/affine.h"
#include "core/math/vec.h"

namespace farpoint {

enum class WrapMode : uint32_t { kRepeat, kMirroredRepeat, kClampToEdge };

// An image as it was in the file; decoded by PrepareScene and only if a material needs it.
struct Texture {
  std::string name;  // for messages: the URI or "image 3"
  Blob encoded;      // PNG, JPEG, … bytes
  WrapMode wrap_s = WrapMode::kRepeat;
  WrapMode wrap_t = WrapMode::kRepeat;
  bool nearest = false;  // magnification without interpolation
};

enum class AlphaMode : uint32_t { kOpaque, kMask };

// uv' = offset + R(rotation) * (scale * uv) (KHR_texture_transform)
struct UvTransform {
  Vec2f offset{0, 0};
  Vec2f scale{1, 1};
  float rotation_rad = 0;
};

struct TextureRef {
  int32_t texture = -1;  // index into Scene::textures; -1: none
  uint32_t uv_set = 0;   // 0 or 1
  UvTransform transform;
  bool present() const { return texture >= 0; }
};

struct Material {
  std::string name;
  Rgb base_color{1, 1, 1};  // linear, [0, 1]; Lambert albedo, or that of glTF's model
  float base_alpha = 1;
  TextureRef base_color_texture;  // sRGB, multiplies base_color and base_alpha
  AlphaMode alpha_mode = AlphaMode::kOpaque;
  float alpha_cutoff = 0.5f;    // kMask: a point with alpha below it is a hole
  Rgb emission;                 // radiance, emitted from both sides (all surfaces are two-sided)
  TextureRef emission_texture;  // sRGB, multiplies emission
  // Shown if PrepareOptions::gloss is set; else every material is Lambert (core/math/microfacet.h).
  // A material without metal, of roughness 1 and without their texture is Lambert anyway.
  float metallic = 0, roughness = 1;
  float dielectric_f0 = 0.04f;  // reflectance at normal incidence where it is no metal, [0, 1)
  TextureRef metal_roughness_texture;  // linear: green multiplies roughness, blue metallic
  TextureRef normal_texture;           // linear: 2 rgb - 1, in the frame of its coordinates
  float normal_scale = 1;              // of its x and y
};

// One primitive: triangles of one material.
struct Mesh {
  std::string name;
  std::vector<Vec3f> positions;          // mesh frame
  std::vector<Vec3f> normals;            // empty: flat; else one per position, any length
  std::array<std::vector<Vec2f>, 2> uv;  // each empty or one per position
  std::vector<std::array<uint32_t, 3>> triangles;
  int32_t material = -1;  // -1: white Lambert, albedo 1 (the glTF default)
};

struct Instance {
  std::string name;
  uint32_t mesh = 0;
  Affine world_from_mesh;
};

enum class PunctualKind : uint32_t { kPoint, kSpot, kDirectional };

struct PunctualLight {
  std::string name;
  PunctualKind kind = PunctualKind::kPoint;
  Vec3d position;      // world; point and spot
  Vec3d direction;     // world, unit, the way the light travels; spot and directional
  Rgb intensity;       // point, spot: W/sr. directional: irradiance on a facing surface, W/m²
  double range_m = 0;  // 0: infinite (glTF's range; window (1 - (d/range)^4) clamped to [0, 1])
  double inner_cone_rad = 0, outer_cone_rad = 0.7853981633974483;  // spot, glTF's falloff
};

// A perspective pinhole.
struct Camera {
  std::string name;
  Vec3d eye;                                             // world
  Vec3d right{1, 0, 0}, up{0, 1, 0}, forward{0, 0, -1};  // orthonormal, world
  double yfov_rad = 0.7;                                 // of the whole frame's height
};

// The radiance that arrives from a direction in which nothing lies: sky + map(direction).
// The map is lat-long as OpenEXR lays it out (ImfEnvmap.h): row 0 is the map's up, +y; a direction
// (x, y, z) of the map's frame has latitude asin(y), from pi/2 at the top edge to -pi/2 at the
// bottom one, and longitude atan2(x, z), from +pi at the left edge to -pi at the right one, so that
// the centre of the image is +z.
struct Environment {
  Rgb sky;  // constant; zero: none
  uint32_t map_width = 0, map_height = 0;
  std::vector<Rgb> map;  // row by row, map_width * map_height finite values >= 0; empty: none
  // World directions of the map's x, y and z: orthonormal, right-handed.
  std::array<Vec3d, 3> world_from_map{Vec3d{1, 0, 0}, Vec3d{0, 1, 0}, Vec3d{0, 0, 1}};
};

struct Scene {
  std::string name;
  std::vector<Texture> textures;
  std::vector<Material> materials;
  std::vector<Mesh> meshes;
  std::vector<Instance> instances;
  std::vector<PunctualLight> lights;
  std::vector<Camera> cameras;
  Environment environment;
};

}  // namespace farpoint
