#include "bench/skip_scenes.h"

#include <string>
#include <utility>
#include <vector>

#include "bench/bench_scene.h"
#include "core/base/check.h"
#include "core/image/png_io.h"
#include "core/math/sampling.h"
#include "core/scene/procedural.h"
#include "core/scene/quad_mesh.h"

namespace farpoint {

namespace {

// The six sides of a box, fronts outside or, if `inwards`, inside.
std::vector<Quad> Box(const Vec3f& a, const Vec3f& b, bool inwards) {
  std::vector<Quad> quads = {
      {{{a.x, a.y, a.z}, {b.x, a.y, a.z}, {b.x, a.y, b.z}, {a.x, a.y, b.z}}},
      {{{a.x, b.y, a.z}, {a.x, b.y, b.z}, {b.x, b.y, b.z}, {b.x, b.y, a.z}}},
      {{{a.x, a.y, a.z}, {a.x, b.y, a.z}, {b.x, b.y, a.z}, {b.x, a.y, a.z}}},
      {{{a.x, a.y, b.z}, {b.x, a.y, b.z}, {b.x, b.y, b.z}, {a.x, b.y, b.z}}},
      {{{a.x, a.y, a.z}, {a.x, a.y, b.z}, {a.x, b.y, b.z}, {a.x, b.y, a.z}}},
      {{{b.x, a.y, a.z}, {b.x, b.y, a.z}, {b.x, b.y, b.z}, {b.x, a.y, b.z}}}};
  if (inwards) {
    for (Quad& q : quads) std::swap(q[1], q[3]);
  }
  return quads;
}

Camera CameraFrom(const Vec3d& eye, const Vec3d& target) {
  return CameraOf({eye, target, 60}).value();  // never straight up or down
}

Scene Floor() {
  Scene scene;
  scene.materials = {LambertMaterial("floor", Rgb(0.6f))};
  AddQuads("floor", 0, {{{{-4, 0, -4}, {-4, 0, 4}, {4, 0, 4}, {4, 0, -4}}}}, scene);
  scene.cameras = {CameraFrom({0, 3, 6}, {0, 0, 0})};
  return scene;
}

}  // namespace

Scene MakeRooms(unsigned n) {
  Scene scene;
  scene.materials = {LambertMaterial("plaster", Rgb(0.7f, 0.68f, 0.62f)),
                     LambertMaterial("wood", Rgb(0.45f, 0.3f, 0.2f)),
                     LambertMaterial("lamp", Rgb(), Rgb(12, 11, 9))};
  const float width = 4.2f;
  std::vector<Quad> walls, furniture, lamps;
  const auto add = [](std::vector<Quad>& to, const std::vector<Quad>& quads) {
    to.insert(to.end(), quads.begin(), quads.end());
  };
  for (unsigned j = 0; j < n; ++j) {
    for (unsigned i = 0; i < n; ++i) {
      const Vec3f o(width * static_cast<float>(i), 0, width * static_cast<float>(j));
      add(walls, Box(o, o + Vec3f(4, 3, 4), true));
      const Quad lamp = {
          Vec3f(1.5f, 2.95f, 1.5f), {2.5f, 2.95f, 1.5f}, {2.5f, 2.95f, 2.5f}, {1.5f, 2.95f, 2.5f}};
      Quad placed;
      for (size_t k = 0; k < 4; ++k) placed[k] = o + lamp[k];
      lamps.push_back(placed);
      for (unsigned f = 0; f < 6; ++f) {
        const auto u = [&](uint64_t k) {
          return ToUnitFloat(static_cast<uint32_t>(HashKey(i, j, f, k)));
        };
        const Vec3f at = o + Vec3f(0.3f + 2.8f * u(0), 0, 0.3f + 2.8f * u(1));
        add(furniture,
            Box(at, at + Vec3f(0.2f + 0.5f * u(2), 0.4f + u(3), 0.2f + 0.5f * u(4)), false));
      }
    }
  }
  AddQuads("walls", 0, walls, scene);
  AddQuads("furniture", 1, furniture, scene);
  AddQuads("lamps", 2, lamps, scene);
  const double middle = static_cast<double>(width) * (n / 2);
  scene.cameras = {
      CameraFrom({middle + 0.3, 2.2, middle + 0.3}, {middle + 2.6, 0.6, middle + 2.4})};
  return scene;
}

Scene MakeBoxes(unsigned n) {
  Scene scene = Floor();
  scene.materials.push_back(LambertMaterial("box", Rgb(0.7f, 0.4f, 0.3f)));
  std::vector<Quad> boxes;
  const float pitch = 7.0f / static_cast<float>(n);
  for (unsigned j = 0; j < n; ++j) {
    for (unsigned i = 0; i < n; ++i) {
      const Vec3f at(-3.5f + pitch * (static_cast<float>(i) + 0.2f), 0.01f,
                     -3.5f + pitch * (static_cast<float>(j) + 0.2f));
      for (const Quad& q : Box(at, at + Vec3f(0.6f * pitch), false)) boxes.push_back(q);
    }
  }
  AddQuads("boxes", 1, boxes, scene);
  PunctualLight sun;
  sun.name = "sun";
  sun.kind = PunctualKind::kDirectional;
  sun.direction = Normalize(Vec3d(0.4, -1, -0.3));
  sun.intensity = Rgb(4);
  scene.lights = {sun};
  return scene;
}

Scene MakeBlackBox() {
  Scene scene = MakeCornellBox();
  scene.materials.push_back(LambertMaterial("black", Rgb()));
  const auto black = static_cast<int32_t>(scene.materials.size() - 1);
  for (Mesh& mesh : scene.meshes) {
    if (mesh.name != "floor" && mesh.name != "light") mesh.material = black;
  }
  return scene;
}

Scene MakeLampBeforeBox() {
  Scene scene = MakeCornellBox();
  scene.materials.push_back(LambertMaterial("panel", Rgb(), Rgb(0.5f)));
  AddQuads("panel", static_cast<int32_t>(scene.materials.size() - 1),
           {{{{-2, -2, -1}, {8, -2, -1}, {8, 3.9f, -1}, {-2, 3.9f, -1}}}}, scene);
  return scene;
}

Scene MakeDarkBox() {
  Scene scene = MakeCornellBox();
  for (Material& material : scene.materials) material.emission = {};
  return scene;
}

Scene MakeSpotsAside() {
  Scene scene = MakeCornellBox();
  for (int i = 0; i < 8; ++i) {
    PunctualLight spot;
    spot.name = "spot " + std::to_string(i);
    spot.kind = PunctualKind::kSpot;
    spot.position = {0.7 * i, 2.5, -2};
    spot.direction = {0, 0, -1};
    spot.intensity = Rgb(50);
    spot.inner_cone_rad = 0.2;
    spot.outer_cone_rad = 0.4;
    scene.lights.push_back(spot);
  }
  return scene;
}

Scene MakeLitFloor() {
  Scene scene = Floor();
  PunctualLight light;
  light.name = "light";
  light.position = {0, 4, 0};
  light.intensity = Rgb(30);
  scene.lights = {light};
  return scene;
}

Scene MakeOpenFloor() {
  Scene scene = Floor();
  scene.environment.sky = Rgb(1, 1.1f, 1.3f);
  return scene;
}

Scene MakeUnusedTextures(unsigned count, unsigned side) {
  Scene scene = MakeCornellBox();
  std::vector<uint8_t> rgb(size_t{3} * side * side);
  for (unsigned t = 0; t < count; ++t) {
    for (size_t i = 0; i < rgb.size(); ++i) rgb[i] = static_cast<uint8_t>(HashKey(t, i / 24));
    absl::StatusOr<std::vector<std::byte>> png =
        EncodePng(static_cast<int>(side), static_cast<int>(side), rgb);
    FP_CHECK(png.ok());
    Texture texture;
    texture.name = "unused " + std::to_string(t);
    texture.encoded = Blob::FromVector(*png);
    scene.textures.push_back(std::move(texture));
    // Of a material that no mesh has.
    Material material = LambertMaterial("unused", Rgb(1));
    material.base_color_texture.texture = static_cast<int32_t>(t);
    scene.materials.push_back(material);
  }
  return scene;
}

}  // namespace farpoint
