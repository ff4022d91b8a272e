#include "core/scene/procedural.h"

#include <vector>

#include "core/math/elementary.h"
#include "core/scene/quad_mesh.h"

namespace farpoint {

namespace {

struct CornellObject {
  const char* name;
  int32_t material;
  std::vector<Quad> quads;
};

enum CornellMaterial : int32_t { kWhite, kRed, kGreen, kLight };

// Cornell University Program of Computer Graphics, "The Cornell Box, measurement data"
// (graphics.cornell.edu/online/box/data.html), in units of 100 mm. The ceiling is cut into four
// quads round the light, which fills the hole in its plane.
std::vector<CornellObject> CornellObjects() {
  return {
      {"floor", kWhite, {{{{5.528f, 0, 0}, {0, 0, 0}, {0, 0, 5.592f}, {5.496f, 0, 5.592f}}}}},
      {"ceiling",
       kWhite,
       {{{{5.56f, 5.488f, 0}, {5.56f, 5.488f, 2.27f}, {0, 5.488f, 2.27f}, {0, 5.488f, 0}}},
        {{{5.56f, 5.488f, 3.32f},
          {5.56f, 5.488f, 5.592f},
          {0, 5.488f, 5.592f},
          {0, 5.488f, 3.32f}}},
        {{{5.56f, 5.488f, 2.27f},
          {5.56f, 5.488f, 3.32f},
          {3.43f, 5.488f, 3.32f},
          {3.43f, 5.488f, 2.27f}}},
        {{{2.13f, 5.488f, 2.27f},
          {2.13f, 5.488f, 3.32f},
          {0, 5.488f, 3.32f},
          {0, 5.488f, 2.27f}}}}},
      {"light",
       kLight,
       {{{{3.43f, 5.488f, 2.27f},
          {3.43f, 5.488f, 3.32f},
          {2.13f, 5.488f, 3.32f},
          {2.13f, 5.488f, 2.27f}}}}},
      {"back",
       kWhite,
       {{{{5.496f, 0, 5.592f}, {0, 0, 5.592f}, {0, 5.488f, 5.592f}, {5.56f, 5.488f, 5.592f}}}}},
      {"right", kGreen, {{{{0, 0, 5.592f}, {0, 0, 0}, {0, 5.488f, 0}, {0, 5.488f, 5.592f}}}}},
      {"left",
       kRed,
       {{{{5.528f, 0, 0}, {5.496f, 0, 5.592f}, {5.56f, 5.488f, 5.592f}, {5.56f, 5.488f, 0}}}}},
      {"short",
       kWhite,
       {{{{1.3f, 1.65f, 0.65f}, {0.82f, 1.65f, 2.25f}, {2.4f, 1.65f, 2.72f}, {2.9f, 1.65f, 1.14f}}},
        {{{2.9f, 0, 1.14f}, {2.9f, 1.65f, 1.14f}, {2.4f, 1.65f, 2.72f}, {2.4f, 0, 2.72f}}},
        {{{1.3f, 0, 0.65f}, {1.3f, 1.65f, 0.65f}, {2.9f, 1.65f, 1.14f}, {2.9f, 0, 1.14f}}},
        {{{0.82f, 0, 2.25f}, {0.82f, 1.65f, 2.25f}, {1.3f, 1.65f, 0.65f}, {1.3f, 0, 0.65f}}},
        {{{2.4f, 0, 2.72f}, {2.4f, 1.65f, 2.72f}, {0.82f, 1.65f, 2.25f}, {0.82f, 0, 2.25f}}}}},
      {"tall",
       kWhite,
       {{{{4.23f, 3.3f, 2.47f}, {2.65f, 3.3f, 2.96f}, {3.14f, 3.3f, 4.56f}, {4.72f, 3.3f, 4.06f}}},
        {{{4.23f, 0, 2.47f}, {4.23f, 3.3f, 2.47f}, {4.72f, 3.3f, 4.06f}, {4.72f, 0, 4.06f}}},
        {{{4.72f, 0, 4.06f}, {4.72f, 3.3f, 4.06f}, {3.14f, 3.3f, 4.56f}, {3.14f, 0, 4.56f}}},
        {{{3.14f, 0, 4.56f}, {3.14f, 3.3f, 4.56f}, {2.65f, 3.3f, 2.96f}, {2.65f, 0, 2.96f}}},
        {{{2.65f, 0, 2.96f}, {2.65f, 3.3f, 2.96f}, {4.23f, 3.3f, 2.47f}, {4.23f, 0, 2.47f}}}}},
  };
}

// 64 slices between the poles and 128 about them.
Mesh MeshOfSphere(const char* name, int32_t material, const Vec3f& center, float radius) {
  constexpr uint32_t kSlices = 64, kAround = 128;
  Mesh mesh;
  mesh.name = name;
  mesh.material = material;
  for (uint32_t j = 0; j <= kSlices; ++j) {
    const SinCos theta = DetSinCos(kPi * j / kSlices);
    for (uint32_t i = 0; i <= kAround; ++i) {
      const SinCos phi = DetSinCos(2 * kPi * (i % kAround) / kAround);
      const Vec3f n(Vec3d(theta.sin * phi.cos, theta.cos, theta.sin * phi.sin));
      mesh.positions.push_back(center + n * radius);
      mesh.normals.push_back(n);
    }
  }
  for (uint32_t j = 0; j < kSlices; ++j) {
    for (uint32_t i = 0; i < kAround; ++i) {
      const uint32_t a = j * (kAround + 1) + i, b = a + kAround + 1;
      if (j > 0) mesh.triangles.push_back({a, a + 1, b + 1});
      if (j + 1 < kSlices) mesh.triangles.push_back({a, b + 1, b});
    }
  }
  return mesh;
}

}  // namespace

Scene MakeCornellBox() {
  Scene scene;
  scene.name = "cornell";
  scene.materials = {LambertMaterial("white", {0.725f, 0.71f, 0.68f}),
                     LambertMaterial("red", {0.63f, 0.065f, 0.05f}),
                     LambertMaterial("green", {0.14f, 0.45f, 0.091f}),
                     LambertMaterial("light", {0, 0, 0}, {17, 12, 4})};
  for (const CornellObject& object : CornellObjects()) {
    AddQuads(object.name, object.material, object.quads, scene);
  }
  Camera camera;
  camera.name = "camera";
  camera.eye = {2.78, 2.73, -8};
  camera.forward = {0, 0, 1};
  camera.up = {0, 1, 0};
  camera.right = {-1, 0, 0};
  // A film of 25 mm behind a lens of 35 mm, square: the same angle across and up.
  camera.yfov_rad = 39.307654 * kPi / 180;
  scene.cameras.push_back(camera);
  return scene;
}

Scene MakeGlossyCornellBox(float roughness) {
  Scene scene = MakeCornellBox();
  scene.name = "glossy cornell";
  Material copper = LambertMaterial("copper", {0.955f, 0.638f, 0.538f});
  copper.metallic = 1;
  copper.roughness = roughness;
  Material plastic = LambertMaterial("plastic", {0.05f, 0.16f, 0.55f});
  plastic.roughness = roughness;
  const auto of_copper = static_cast<int32_t>(scene.materials.size());
  scene.materials.push_back(std::move(copper));
  scene.materials.push_back(std::move(plastic));
  for (Mesh& mesh : scene.meshes) {
    if (mesh.name == "tall") mesh.material = of_copper;
    if (mesh.name == "short") {
      mesh = MeshOfSphere("sphere", of_copper + 1, {1.86f, 0.95f, 1.69f}, 0.95f);
    }
  }
  for (Instance& instance : scene.instances) {
    if (instance.name == "short") instance.name = "sphere";
  }
  return scene;
}

Scene MakeFurnace(float rho, float radiance) {
  Scene scene;
  scene.name = "furnace";
  scene.materials = {LambertMaterial("furnace", Rgb(rho), Rgb(radiance))};
  // Wound so that the fronts face inwards.
  const std::vector<Quad> walls = {{{{-1, -1, -1}, {-1, -1, 1}, {1, -1, 1}, {1, -1, -1}}},
                                   {{{-1, 1, -1}, {1, 1, -1}, {1, 1, 1}, {-1, 1, 1}}},
                                   {{{-1, -1, -1}, {1, -1, -1}, {1, 1, -1}, {-1, 1, -1}}},
                                   {{{-1, -1, 1}, {-1, 1, 1}, {1, 1, 1}, {1, -1, 1}}},
                                   {{{-1, -1, -1}, {-1, 1, -1}, {-1, 1, 1}, {-1, -1, 1}}},
                                   {{{1, -1, -1}, {1, -1, 1}, {1, 1, 1}, {1, 1, -1}}}};
  AddQuads("walls", 0, walls, scene);
  Camera camera;
  camera.name = "centre";
  camera.yfov_rad = 1.2;
  scene.cameras.push_back(camera);
  return scene;
}

}  // namespace farpoint
