#include "bench/paper_scenes.h"

#include <algorithm>
#include <array>
#include <limits>
#include <utility>

#include "bench/accuracy_scenes.h"
#include "bench/text.h"
#include "core/scene/quad_mesh.h"

namespace farpoint {

namespace {

constexpr double kMinute = 60.0;

constexpr std::array<PaperScene, 4> kScenes = {{
    {"cornell",
     "CornellBox",
     "the box as measured at Cornell University, lit by its own light",
     "",
     1024,
     1024,
     88'880,
     {88.88e3, 0.68, 2.46 * kMinute, 0.65 * kMinute, 1.73 * kMinute, 1.19 * kMinute, 5.72 * kMinute,
      2.60 * kMinute, 103, 8.79e-6}},
    {"bunny",
     "Bunny",
     "the Stanford bunny in an open room with a red and a green wall, lit by a sun; the paper does "
     "not say what surrounds its bunny",
     "bunny/stanford-bunny.obj",
     1280,
     1000,
     1'000'000,
     {1.00e6, 0.87, 2.38 * kMinute, 0.56 * kMinute, 1.55 * kMinute, 1.08 * kMinute, 4.49 * kMinute,
      2.03 * kMinute, 61, 1.31e-4}},
    {"city",
     "ItalianCity",
     "a city of our own, made by code, sun and sky, seen from a street: not the paper's model",
     "",
     1280,
     1000,
     8'380'000,
     {8.38e6, 0.87, 3.65 * kMinute, 1.08 * kMinute, 1.23 * kMinute, 0.64 * kMinute, 5.52 * kMinute,
      2.34 * kMinute, 235, 8.15e-5}},
    {"sponza",
     "Sponza",
     "Crytek's Sponza, a sun through the open roof; camera and light are ours",
     "sponza/Sponza.gltf",
     1280,
     1000,
     16'190'000,
     {16.19e6, 0.87, 19.71 * kMinute, 3.77 * kMinute, 5.40 * kMinute, 1.68 * kMinute,
      26.72 * kMinute, 7.04 * kMinute, 15, 2.51e-5}},
}};

struct Box {
  Vec3d low = Vec3d(1, 1, 1) * std::numeric_limits<double>::infinity();
  Vec3d high = low * -1.0;
};

Box BoundsOf(const Scene& scene) {
  Box box;
  for (const Instance& instance : scene.instances) {
    for (const Vec3f& p : scene.meshes[instance.mesh].positions) {
      const Vec3d w = instance.world_from_mesh.Point(Vec3d(p));
      for (int i = 0; i < 3; ++i) {
        box.low[i] = std::min(box.low[i], w[i]);
        box.high[i] = std::max(box.high[i], w[i]);
      }
    }
  }
  return box;
}

int32_t AddMaterial(Scene& scene, const char* name, const Rgb& albedo) {
  scene.materials.push_back(LambertMaterial(name, albedo));
  return static_cast<int32_t>(scene.materials.size()) - 1;
}

// A parallelogram of corner and two edges.
Quad Parallelogram(const Vec3d& corner, const Vec3d& u, const Vec3d& v) {
  return {Vec3f(corner), Vec3f(corner + u), Vec3f(corner + u + v), Vec3f(corner + v)};
}

// Floor, back and two coloured walls about what the scene holds; all lengths follow its height.
void AddRoom(Scene& scene) {
  const Box box = BoundsOf(scene);
  const double h = box.high.y - box.low.y;
  const int32_t grey = AddMaterial(scene, "grey", {0.7f, 0.7f, 0.7f});
  const int32_t red = AddMaterial(scene, "red", {0.63f, 0.06f, 0.05f});
  const int32_t green = AddMaterial(scene, "green", {0.14f, 0.45f, 0.09f});
  const Vec3d middle = (box.low + box.high) * 0.5;
  const double x0 = middle.x - 1.25 * h, x1 = middle.x + 1.25 * h;
  const double z0 = middle.z - 1.0 * h, z1 = middle.z + 1.5 * h;
  const double y = box.low.y;
  const Vec3d across(x1 - x0, 0, 0), up(0, 1.9 * h, 0), along(0, 0, z1 - z0);
  AddQuads("floor", grey, {Parallelogram({x0, y, z0}, along, across)}, scene);
  AddQuads("back", grey, {Parallelogram({x0, y, z0}, across, up)}, scene);
  AddQuads("left", red, {Parallelogram({x0, y, z0}, up, along)}, scene);
  AddQuads("right", green, {Parallelogram({x1, y, z0}, along, up)}, scene);
}

AccuracyCase CaseOf(const PaperScene& scene) {
  AccuracyCase c;
  c.name = scene.name;
  c.scene = scene.file.empty() ? scene.name : scene.file;
  if (scene.name == "sponza") {
    c.sun = AccuracySun{{0.3, 1, 0.1}, Rgb(10, 10, 10)};
    c.view = AccuracyView{{9, 0.8, -0.3}, {-8, 4, -0.3}, 57};
  }
  if (scene.name == "bunny") c.sun = AccuracySun{{0.45, 1, 0.75}, Rgb(4, 4, 4)};
  return c;
}

}  // namespace

std::span<const PaperScene> PaperScenes() { return kScenes; }

absl::StatusOr<const PaperScene*> FindPaperScene(std::string_view name) {
  std::string known;
  for (const PaperScene& scene : kScenes) {
    if (scene.name == name) return &scene;
    Append(known, {known.empty() ? "" : ", ", scene.name});
  }
  return absl::InvalidArgumentError(Concat({"--scene ", name, " is none of ", known}));
}

absl::StatusOr<std::optional<PaperView>> LoadPaperScene(const PaperScene& scene,
                                                        const std::string& scenes_dir, bool quick,
                                                        std::string& missing) {
  FP_ASSIGN_OR_RETURN(
      std::optional<AccuracyScene> loaded,
      LoadAccuracyScene(CaseOf(scene), AccuracyFolders{scenes_dir, {}}, quick, missing));
  if (!loaded) return std::nullopt;
  PaperView view{std::move(loaded->scene), loaded->camera, std::move(loaded->notes)};
  if (scene.name == "bunny") {
    const Box box = BoundsOf(view.scene);
    const double h = box.high.y - box.low.y;
    const int32_t clay = AddMaterial(view.scene, "clay", {0.6f, 0.58f, 0.55f});
    for (Mesh& mesh : view.scene.meshes) mesh.material = clay;
    AddRoom(view.scene);
    const Vec3d target = (box.low + box.high) * 0.5 + Vec3d(0, 0.12 * h, 0);
    FP_ASSIGN_OR_RETURN(view.camera, CameraOf({target + Vec3d(0, 0.35 * h, 3.6 * h), target, 33}));
    // What the importer says of camera and light is no longer so.
    view.notes.clear();
  }
  return std::optional<PaperView>(std::move(view));
}

}  // namespace farpoint
