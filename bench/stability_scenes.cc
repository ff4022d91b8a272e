#include "bench/stability_scenes.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <numeric>
#include <string>
#include <utility>

#include "bench/bench_scene.h"
#include "core/math/elementary.h"
#include "core/math/sampling.h"
#include "core/scene/procedural.h"
#include "core/scene/quad_mesh.h"

namespace farpoint {

namespace {

constexpr double kNeedle = 1e-6;  // width over length

float Unit(uint64_t key) { return ToUnitFloat(static_cast<uint32_t>(key >> 32)); }

// A vertex of `mesh` between two others, with all that vertices have; returns its index.
uint32_t AddBetween(Mesh& mesh, uint32_t a, uint32_t b, double t) {
  const auto mix = [&](const Vec3f& x, const Vec3f& y) {
    return Vec3f(Vec3d(x) * (1 - t) + Vec3d(y) * t);
  };
  mesh.positions.push_back(mix(mesh.positions[a], mesh.positions[b]));
  if (!mesh.normals.empty()) mesh.normals.push_back(mix(mesh.normals[a], mesh.normals[b]));
  for (auto& uv : mesh.uv) {
    if (uv.empty()) continue;
    const float s = static_cast<float>(t);
    uv.push_back({uv[a].x + s * (uv[b].x - uv[a].x), uv[a].y + s * (uv[b].y - uv[a].y)});
  }
  return static_cast<uint32_t>(mesh.positions.size() - 1);
}

PunctualLight Sun(const Vec3d& direction, const Rgb& irradiance) {
  PunctualLight sun;
  sun.name = "sun";
  sun.kind = PunctualKind::kDirectional;
  sun.direction = Normalize(direction);
  sun.intensity = irradiance;
  return sun;
}

Mesh Icosahedron(const Vec3f& centre, float radius, int32_t material) {
  const float g = 1.6180340f;
  const float s = radius / std::sqrt(1 + g * g);
  const std::array<Vec3f, 12> corner = {{{-1, g, 0},
                                         {1, g, 0},
                                         {-1, -g, 0},
                                         {1, -g, 0},
                                         {0, -1, g},
                                         {0, 1, g},
                                         {0, -1, -g},
                                         {0, 1, -g},
                                         {g, 0, -1},
                                         {g, 0, 1},
                                         {-g, 0, -1},
                                         {-g, 0, 1}}};
  Mesh mesh;
  mesh.name = "ball";
  mesh.material = material;
  for (const Vec3f& c : corner) mesh.positions.push_back(centre + c * s);
  mesh.triangles = {{0, 11, 5}, {0, 5, 1},  {0, 1, 7},   {0, 7, 10}, {0, 10, 11},
                    {1, 5, 9},  {5, 11, 4}, {11, 10, 2}, {10, 7, 6}, {7, 1, 8},
                    {3, 9, 4},  {3, 4, 2},  {3, 2, 6},   {3, 6, 8},  {3, 8, 9},
                    {4, 9, 5},  {2, 4, 11}, {6, 2, 10},  {8, 6, 7},  {9, 8, 1}};
  return mesh;
}

void AddMesh(Mesh mesh, Scene& scene) {
  scene.instances.push_back({mesh.name, static_cast<uint32_t>(scene.meshes.size()), {}});
  scene.meshes.push_back(std::move(mesh));
}

}  // namespace

Camera CameraAt(const Vec3d& eye, const Vec3d& target, double yfov_deg) {
  return CameraOf({eye, target, yfov_deg}).value();  // callers never look straight up or down
}

StabilityScene Transformed(const StabilityScene& source, const Affine& world, double scale) {
  StabilityScene out = source;
  for (Instance& instance : out.scene.instances) {
    instance.world_from_mesh = world * instance.world_from_mesh;
  }
  for (PunctualLight& light : out.scene.lights) {
    light.position = world.Point(light.position);
    light.direction = NormalizeOr(world.Vector(light.direction), light.direction);
    if (light.kind != PunctualKind::kDirectional) {
      light.intensity = Rgb(Vec3d(light.intensity) * (scale * scale));
      light.range_m *= scale;
    }
  }
  Camera& camera = out.camera;
  camera.eye = world.Point(camera.eye);
  for (Vec3d* axis : {&camera.right, &camera.up, &camera.forward}) {
    *axis = world.Vector(*axis) / scale;
  }
  out.scene.cameras = {camera};
  return out;
}

Affine ScalingBy(double scale) {
  Affine a;
  for (Vec3d& column : a.column) column = column * scale;
  return a;
}

Affine TranslationBy(const Vec3d& offset) {
  Affine a;
  a.translation = offset;
  return a;
}

Affine RotationAbout(const Vec3d& axis, double angle_rad) {
  const Vec3d k = Normalize(axis);
  const SinCos r = DetSinCos(angle_rad);
  Affine a;
  for (Vec3d& column : a.column) {  // Rodrigues
    column = column * r.cos + Cross(k, column) * r.sin + k * (Dot(k, column) * (1 - r.cos));
  }
  return a;
}

Affine MirroringX() {
  Affine a;
  a.column[0] = {-1, 0, 0};
  return a;
}

Scene Permuted(const Scene& source, uint64_t seed) {
  Scene out = source;
  // Meshes from the last to the first, triangles by their hashes, corners turned by one or two.
  std::reverse(out.meshes.begin(), out.meshes.end());
  std::reverse(out.instances.begin(), out.instances.end());
  for (Instance& instance : out.instances) {
    instance.mesh = static_cast<uint32_t>(out.meshes.size() - 1) - instance.mesh;
  }
  for (size_t m = 0; m < out.meshes.size(); ++m) {
    auto& triangles = out.meshes[m].triangles;
    std::vector<size_t> order(triangles.size());
    std::iota(order.begin(), order.end(), size_t{0});
    std::sort(order.begin(), order.end(), [&](size_t a, size_t b) {
      return std::pair(HashKey(seed, m, a), a) < std::pair(HashKey(seed, m, b), b);
    });
    std::vector<std::array<uint32_t, 3>> shuffled;
    for (const size_t t : order) {
      std::array<uint32_t, 3> triangle = triangles[t];
      std::rotate(triangle.begin(), triangle.begin() + static_cast<int>(t % 3), triangle.end());
      shuffled.push_back(triangle);
    }
    triangles = std::move(shuffled);
  }
  return out;
}

Scene Split(const Scene& source) {
  Scene out = source;
  for (Mesh& mesh : out.meshes) {
    std::vector<std::array<uint32_t, 3>> cut;
    const auto triangles = mesh.triangles;
    for (const auto& t : triangles) {
      const uint32_t ab = AddBetween(mesh, t[0], t[1], 0.5);
      const uint32_t bc = AddBetween(mesh, t[1], t[2], 0.5);
      const uint32_t ca = AddBetween(mesh, t[2], t[0], 0.5);
      cut.push_back({t[0], ab, ca});
      cut.push_back({ab, t[1], bc});
      cut.push_back({ca, bc, t[2]});
      cut.push_back({ab, bc, ca});
    }
    mesh.triangles = std::move(cut);
  }
  const size_t meshes = out.meshes.size();
  for (size_t m = 0; m < meshes; ++m) {
    Mesh other = out.meshes[m];
    std::vector<std::array<uint32_t, 3>> even, odd;
    for (size_t t = 0; t < other.triangles.size(); ++t) {
      (t % 2 == 0 ? even : odd).push_back(other.triangles[t]);
    }
    other.triangles = std::move(odd);
    out.meshes[m].triangles = std::move(even);
    out.meshes.push_back(std::move(other));
  }
  const size_t instances = out.instances.size();
  for (size_t i = 0; i < instances; ++i) {
    Instance second = out.instances[i];
    second.mesh += static_cast<uint32_t>(meshes);
    out.instances.push_back(std::move(second));
  }
  return out;
}

Scene WithFlatTriangles(const Scene& source) {
  Scene out = source;
  for (Mesh& mesh : out.meshes) {
    const auto triangles = mesh.triangles;
    for (const auto& t : triangles) {
      mesh.triangles.push_back({t[0], t[0], t[1]});
      mesh.triangles.push_back({t[2], t[2], t[2]});
      const uint32_t between = AddBetween(mesh, t[0], t[1], 0.5);
      mesh.triangles.push_back({t[0], between, t[1]});
    }
  }
  return out;
}

Scene WithFlatMeshes(const Scene& source) {
  Scene out = source;
  for (size_t m = 0; m < source.meshes.size(); ++m) {
    Mesh mesh = source.meshes[m];
    mesh.name += " flat";
    for (auto& t : mesh.triangles) t[2] = t[0];
    for (const Instance& instance : source.instances) {
      if (instance.mesh != m) continue;
      Instance flat = instance;
      flat.mesh = static_cast<uint32_t>(out.meshes.size());
      out.instances.push_back(std::move(flat));
    }
    out.meshes.push_back(std::move(mesh));
  }
  return out;
}

Scene WithStray(const Scene& source, const Vec3d& at) {
  Scene out = source;
  Mesh mesh;
  mesh.name = "stray";
  mesh.positions = {{0, 0, 0}, {1, 0, 0}, {0, 1, 0}};
  mesh.triangles = {{0, 1, 2}};
  Instance instance;
  instance.name = "stray";
  instance.mesh = static_cast<uint32_t>(out.meshes.size());
  instance.world_from_mesh = TranslationBy(at);
  out.meshes.push_back(std::move(mesh));
  out.instances.push_back(std::move(instance));
  return out;
}

Scene WithBlackGround(const Scene& source, double half_m, double y) {
  Scene out = source;
  const auto h = static_cast<float>(half_m), height = static_cast<float>(y);
  Mesh mesh;
  mesh.name = "ground";
  mesh.positions = {{-h, height, -h}, {-h, height, h}, {h, height, h}, {h, height, -h}};
  mesh.triangles = {{0, 1, 2}, {0, 2, 3}};
  mesh.material = static_cast<int32_t>(out.materials.size());
  Material black;
  black.name = "black";
  black.base_color = Rgb();
  out.materials.push_back(std::move(black));
  Instance instance;
  instance.name = "ground";
  instance.mesh = static_cast<uint32_t>(out.meshes.size());
  out.meshes.push_back(std::move(mesh));
  out.instances.push_back(std::move(instance));
  return out;
}

Scene WithNeedles(const Scene& source) {
  Scene out = source;
  for (Mesh& mesh : out.meshes) {
    const auto triangles = mesh.triangles;
    mesh.triangles.clear();
    for (const auto& t : triangles) {
      // From the second corner towards the first, a millionth of the way.
      const uint32_t cut = AddBetween(mesh, t[1], t[0], kNeedle);
      mesh.triangles.push_back({t[0], cut, t[2]});
      mesh.triangles.push_back({cut, t[1], t[2]});
    }
  }
  return out;
}

Scene WithDuplicates(const Scene& source) {
  Scene out = source;
  for (const Instance& instance : source.instances) {
    out.instances.push_back(instance);
    out.instances.back().name += " again";
  }
  return out;
}

Scene WithFlatNormals(const Scene& source) {
  Scene out = source;
  for (Mesh& mesh : out.meshes) {
    mesh.normals.assign(mesh.positions.size(), Vec3f());
    for (const auto& t : mesh.triangles) {
      const Vec3d a(mesh.positions[t[0]]), b(mesh.positions[t[1]]), c(mesh.positions[t[2]]);
      for (const uint32_t v : t) mesh.normals[v] = Vec3f(NormalizeOr(Cross(b - a, c - a), Vec3d()));
    }
  }
  return out;
}

Scene WithNormals(const Scene& source, BadNormals kind) {
  Scene out = WithFlatNormals(source);
  const float nan = std::numeric_limits<float>::quiet_NaN();
  const float infinity = std::numeric_limits<float>::infinity();
  for (Mesh& mesh : out.meshes) {
    for (Vec3f& n : mesh.normals) {
      switch (kind) {
        case BadNormals::kLong:
          n = n * 0x1p100f;
          break;
        case BadNormals::kTiny:
          n = n * 0x1p-100f;
          break;
        case BadNormals::kZero:
          n = {};
          break;
        case BadNormals::kNan:
          n.y = nan;
          break;
        case BadNormals::kInfinite:
          n.x = infinity;
          break;
        case BadNormals::kOpposed:
          n = -n;
          break;
      }
    }
  }
  return out;
}

StabilityScene SheetsInTheBox() {
  Scene scene = MakeCornellBox();
  Mesh sheets;
  sheets.name = "sheets";
  sheets.material = 0;
  sheets.positions = {{1.8f, 0, 3.6f}, {1.8f, 1.5f, 3.6f}};
  for (const auto& [x, z] : {std::pair(0.8f, 3.2f), std::pair(2.4f, 2.9f), std::pair(1.9f, 4.8f)}) {
    const auto first = static_cast<uint32_t>(sheets.positions.size());
    sheets.positions.push_back({x, 0, z});
    sheets.positions.push_back({x, 1.5f, z});
    sheets.triangles.push_back({0, first, first + 1});
    sheets.triangles.push_back({0, first + 1, 1});
  }
  AddMesh(std::move(sheets), scene);
  const Camera camera = scene.cameras.front();
  return {std::move(scene), camera};
}

StabilityScene TinyBesideHuge(unsigned n) {
  Scene scene;
  scene.materials = {LambertMaterial("ground", Rgb(0.6f)), LambertMaterial("bowl", Rgb(0.7f))};
  AddQuads("ground", 0,
           {{{{-1000, 0, 1000}, {1000, 0, 1000}, {1000, 0, -1000}, {-1000, 0, -1000}}}}, scene);
  // A paraboloid of n x n squares of a millimetre, its rim above its middle by half its radius.
  Mesh bowl;
  bowl.name = "bowl";
  bowl.material = 1;
  const float half = 0.0005f * static_cast<float>(n);
  for (unsigned j = 0; j <= n; ++j) {
    for (unsigned i = 0; i <= n; ++i) {
      const float x = 0.001f * static_cast<float>(i) - half;
      const float z = 0.001f * static_cast<float>(j) - half;
      bowl.positions.push_back({x, 0.02f * half + 0.25f * (x * x + z * z) / half, z});
    }
  }
  for (unsigned j = 0; j < n; ++j) {
    for (unsigned i = 0; i < n; ++i) {
      const uint32_t a = j * (n + 1) + i, b = a + 1, c = a + n + 1, d = c + 1;
      bowl.triangles.push_back({a, c, d});
      bowl.triangles.push_back({a, d, b});
    }
  }
  AddMesh(std::move(bowl), scene);
  scene.lights = {Sun({0.3, -1, -0.2}, Rgb(10, 10, 9))};
  const double h = static_cast<double>(half);
  const Camera camera = CameraAt({2.2 * h, 2 * h, 2.6 * h}, {0, 0.2 * h, 0}, 45);
  scene.cameras = {camera};
  return {std::move(scene), camera};
}

StabilityScene OnePlane() {
  Scene scene;
  scene.materials = {LambertMaterial("plane", Rgb(0.8f))};
  // Not along the axes, so that its surfels' heights differ by rounding.
  AddQuads("plane", 0, {{{{-30, -8, 30}, {30, 7, 30}, {30, 8.5f, -30}, {-30, -6.5f, -30}}}}, scene);
  scene.lights = {Sun({0.3, -1, -0.2}, Rgb(10, 10, 9))};
  const Camera camera = CameraAt({0, 3, 6}, {0, 0, 0}, 45);
  scene.cameras = {camera};
  return {std::move(scene), camera};
}

StabilityScene BrightBesideDim(float bright, float dim) {
  Scene scene = MakeFurnace(0.5f, dim);
  scene.materials.push_back(LambertMaterial("bright", Rgb(0.5f), Rgb(bright)));
  Mesh other = scene.meshes.front();
  other.name = "bright";
  other.material = 1;
  scene.meshes.push_back(std::move(other));
  Instance instance{"bright", 1, {}};
  instance.world_from_mesh.translation = {2.5, 0, 0};
  scene.instances.push_back(std::move(instance));
  const Camera camera = scene.cameras.front();
  return {std::move(scene), camera};
}

StabilityScene Leaves(unsigned count, uint64_t seed) {
  Scene scene;
  scene.materials = {LambertMaterial("ground", Rgb(0.5f)),
                     LambertMaterial("leaf", {0.3f, 0.6f, 0.2f}),
                     LambertMaterial("ball", {0.7f, 0.4f, 0.3f})};
  AddQuads("ground", 0, {{{{-12, 0, 12}, {12, 0, 12}, {12, 0, -12}, {-12, 0, -12}}}}, scene);
  std::vector<Quad> leaves;
  for (unsigned i = 0; i < count; ++i) {
    const auto random = [&](uint64_t d) { return Unit(HashKey(seed, i, d)); };
    const Vec3f centre(8 * random(0) - 4, 0.4f + 2.6f * random(1), 8 * random(2) - 4);
    const Vec3f n = UniformSphere(random(3), random(4));
    const Frame frame(n);
    const float r = 0.08f;
    leaves.push_back({centre - frame.t * r - frame.b * r, centre + frame.t * r - frame.b * r,
                      centre + frame.t * r + frame.b * r, centre - frame.t * r + frame.b * r});
    if (i % 16 == 0) {
      const Vec3f at(10 * random(5) - 5, 0.3f + random(6), 10 * random(7) - 5);
      AddMesh(Icosahedron(at, 0.15f, 2), scene);
    }
  }
  AddQuads("leaves", 1, leaves, scene);
  scene.lights = {Sun({0.4, -1, -0.3}, Rgb(10, 10, 9))};
  const Camera camera = CameraAt({7, 4, 9}, {0, 0.8, 0}, 50);
  scene.cameras = {camera};
  return {std::move(scene), camera};
}

StabilityScene Contact() {
  Scene scene = MakeCornellBox();
  const Camera camera = CameraAt({0.2, 0.5, 0.6}, {1.1, 0.05, 1.4}, 45);
  return {std::move(scene), camera};
}

}  // namespace farpoint
