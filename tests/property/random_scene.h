// Random finite scenes, from harmless to hostile. Include after gtest.
#pragma once

#include <rapidcheck.h>

#include <array>
#include <cmath>
#include <string>
#include <utility>
#include <vector>

#include "core/math/sampling.h"
#include "core/scene/scene.h"

namespace farpoint {

// A stream of numbers from one that RapidCheck chose, so that a counterexample is one number.
class SceneDice {
 public:
  explicit SceneDice(uint64_t seed) : seed_(seed) {}
  uint64_t Next() { return HashKey(seed_, ++count_); }
  size_t Below(size_t n) { return Next() % n; }
  bool OneIn(size_t n) { return Below(n) == 0; }
  double Unit() { return static_cast<double>(Next() >> 11) * 0x1p-53; }
  // In [-1, 1], now and then one of the numbers that make things coincide.
  double Coordinate() {
    constexpr std::array kSpecial = {0.0, 1.0, -1.0, 0.5, 1e-7, -1e-7};
    return OneIn(3) ? kSpecial[Below(kSpecial.size())] : 2 * Unit() - 1;
  }
  // From 10^-6 to 10^6, or 0.
  float Power() { return OneIn(8) ? 0.0f : static_cast<float>(std::pow(10.0, 12 * Unit() - 6)); }

 private:
  uint64_t seed_, count_ = 0;
};

inline Scene RandomScene(uint64_t seed) {
  SceneDice dice(seed);
  Scene scene;
  const size_t materials = 1 + dice.Below(3);
  for (size_t m = 0; m < materials; ++m) {
    Material material;
    material.name = "m" + std::to_string(m);
    for (int c = 0; c < 3; ++c) {
      material.base_color[c] = dice.OneIn(4) ? 1.0f : static_cast<float>(dice.Unit());
    }
    if (dice.OneIn(3)) material.emission = Rgb(dice.Power(), dice.Power(), dice.Power());
    scene.materials.push_back(std::move(material));
  }
  const size_t meshes = 1 + dice.Below(4);
  for (size_t m = 0; m < meshes; ++m) {
    Mesh mesh;
    mesh.name = "mesh";
    mesh.material = static_cast<int32_t>(dice.Below(materials));
    const size_t vertices = 3 + dice.Below(9);
    for (size_t v = 0; v < vertices; ++v) {
      mesh.positions.push_back(
          Vec3f(Vec3d(dice.Coordinate(), dice.Coordinate(), dice.Coordinate())));
    }
    const size_t triangles = dice.Below(14);
    for (size_t t = 0; t < triangles; ++t) {
      std::array<uint32_t, 3> triangle;
      for (uint32_t& v : triangle) v = static_cast<uint32_t>(dice.Below(vertices));
      mesh.triangles.push_back(triangle);
    }
    if (dice.OneIn(3)) {
      constexpr float kOdd[] = {0.0f, -1.0f, 1e30f, 1e-30f, NAN, INFINITY};
      for (size_t v = 0; v < vertices; ++v) {
        Vec3f n(Vec3d(dice.Coordinate(), dice.Coordinate(), dice.Coordinate()));
        if (dice.OneIn(4)) n[static_cast<int>(dice.Below(3))] = kOdd[dice.Below(std::size(kOdd))];
        mesh.normals.push_back(n);
      }
    }
    Instance instance{"instance", static_cast<uint32_t>(scene.meshes.size()), {}};
    if (dice.OneIn(2)) {
      for (Vec3d& column : instance.world_from_mesh.column) {
        column = {dice.Coordinate(), dice.Coordinate(), dice.Coordinate()};
      }
    }
    scene.meshes.push_back(std::move(mesh));
    scene.instances.push_back(instance);
    if (dice.OneIn(4)) scene.instances.push_back(instance);  // twice in one place
  }
  const size_t lights = dice.Below(4);
  for (size_t l = 0; l < lights; ++l) {
    PunctualLight light;
    light.kind = static_cast<PunctualKind>(dice.Below(3));
    light.position = {dice.Coordinate(), dice.Coordinate(), dice.Coordinate()};
    // Exactly at a vertex, now and then.
    if (dice.OneIn(3)) light.position = Vec3d(scene.meshes[0].positions[0]);
    light.direction = {dice.Coordinate(), dice.Coordinate(), dice.Coordinate()};
    if (MaxAbs(light.direction) == 0) light.direction = {0, -1, 0};
    light.direction = Normalize(light.direction);
    light.intensity = Rgb(dice.Power(), dice.Power(), dice.Power());
    if (dice.OneIn(3)) light.range_m = 3 * dice.Unit();
    scene.lights.push_back(std::move(light));
  }
  if (dice.OneIn(3)) scene.environment.sky = Rgb(dice.Power());
  Camera camera;
  camera.eye = {dice.Coordinate(), dice.Coordinate(), 2 * dice.Coordinate()};
  if (dice.OneIn(4)) camera.eye = Vec3d(scene.meshes[0].positions[0]);
  camera.yfov_rad = 0.3 + 2 * dice.Unit();
  scene.cameras.push_back(camera);
  return scene;
}

}  // namespace farpoint
