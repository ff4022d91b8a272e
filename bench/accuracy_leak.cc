#include <algorithm>
#include <cmath>
#include <utility>

#include "absl/strings/str_format.h"
#include "bench/accuracy_checks.h"
#include "bench/accuracy_frame.h"
#include "bench/accuracy_pictures.h"
#include "bench/text.h"
#include "core/render/bake.h"
#include "core/scene/quad_mesh.h"

namespace farpoint {

namespace {

constexpr double kRoomBar = 0.001, kWallBar = 0.005;

// The six sides of a box; surfaces are two-sided, so their order does not matter.
std::vector<Quad> BoxQuads(const Vec3d& from, const Vec3d& to) {
  const Vec3f a(from), b(to);
  return {{{{a.x, a.y, a.z}, {b.x, a.y, a.z}, {b.x, a.y, b.z}, {a.x, a.y, b.z}}},
          {{{a.x, b.y, a.z}, {a.x, b.y, b.z}, {b.x, b.y, b.z}, {b.x, b.y, a.z}}},
          {{{a.x, a.y, a.z}, {a.x, b.y, a.z}, {b.x, b.y, a.z}, {b.x, a.y, a.z}}},
          {{{a.x, a.y, b.z}, {b.x, a.y, b.z}, {b.x, b.y, b.z}, {a.x, b.y, b.z}}},
          {{{a.x, a.y, a.z}, {a.x, a.y, b.z}, {a.x, b.y, b.z}, {a.x, b.y, a.z}}},
          {{{b.x, a.y, a.z}, {b.x, b.y, a.z}, {b.x, b.y, b.z}, {b.x, a.y, b.z}}}};
}

Camera MakeCamera(const char* name, const Vec3d& eye, const Vec3d& target) {
  Camera camera = CameraOf({eye, target, 75}).value();  // never straight up or down
  camera.name = name;
  return camera;
}

// A wall between x0 and x1, y0 and y1, z0 and z1, or, if one of them is nothing, a quad.
std::vector<Quad> WallQuads(const Vec3d& from, const Vec3d& to) {
  const Vec3f a(from), b(to);
  if (a.x == b.x) return {{{{a.x, a.y, a.z}, {a.x, b.y, a.z}, {a.x, b.y, b.z}, {a.x, a.y, b.z}}}};
  if (a.y == b.y) return {{{{a.x, a.y, a.z}, {b.x, a.y, a.z}, {b.x, a.y, b.z}, {a.x, a.y, b.z}}}};
  if (a.z == b.z) return {{{{a.x, a.y, a.z}, {b.x, a.y, a.z}, {b.x, b.y, a.z}, {a.x, b.y, a.z}}}};
  return BoxQuads(from, to);
}

struct Lit {
  double mean = 0, max = 0;  // of the largest channel, W/m²
  Film film;
};

absl::StatusOr<Lit> Irradiance(const LoadedFrame& loaded, const Camera& camera,
                               RenderSettings settings, Executor& executor) {
  SparseFrame frame = loaded.frame;
  frame.camera = camera;
  settings.layers = {Layer::kBeauty, Layer::kDepth, Layer::kIrradiance};
  FP_ASSIGN_OR_RETURN(RenderedFrame rendered, RenderByTiles(frame, settings, executor));
  Lit lit;
  double n = 0;
  const PixelRect& r = rendered.film.rect();
  for (int y = r.y0; y < r.y1; ++y) {
    for (int x = r.x0; x < r.x1; ++x) {
      if (!std::isfinite(rendered.film.Get(Layer::kDepth, 0, x, y))) continue;
      double e = 0;
      for (int c = 0; c < 3; ++c) {
        e = std::max(e, static_cast<double>(rendered.film.Get(Layer::kIrradiance, c, x, y)));
      }
      lit.mean += e;
      lit.max = std::max(lit.max, e);
      n += 1;
    }
  }
  if (n > 0) lit.mean /= n;
  lit.film = std::move(rendered.film);
  return lit;
}

}  // namespace

Scene MakeDarkRoom(double t) {
  Scene scene;
  scene.name = "dark room";
  scene.materials = {LambertMaterial("plaster", Rgb(0.8f)), LambertMaterial("ground", Rgb(0.5f)),
                     LambertMaterial("bricks", Rgb(0.7f, 0.4f, 0.3f))};
  AddQuads("ground", 1, {{{{-20, 0, -20}, {-20, 0, 20}, {20, 0, 20}, {20, 0, -20}}}}, scene);
  // The walls reach through each other, so that no crack is left; floor and ceiling too.
  const double half = 2, height = 3;
  const double out = half + t;
  std::vector<Quad> walls;
  const auto wall = [&](const Vec3d& from, const Vec3d& to) {
    for (const auto& quad : WallQuads(from, to)) walls.push_back(quad);
  };
  const double low = 0.01, high = low + height;  // the floor lies above the ground
  const double lap = 0.05;
  wall({-out, low - 0.005, -out - lap}, {-half, high + lap, out + lap});
  wall({half, low - 0.005, -out - lap}, {out, high + lap, out + lap});
  wall({-out - lap, low - 0.005, -out}, {out + lap, high + lap, -half});
  wall({-out - lap, low - 0.005, half}, {out + lap, high + lap, out});
  wall({-out - lap, high, -out - lap}, {out + lap, high + t, out + lap});
  wall({-out - lap, low, -out - lap}, {out + lap, low, out + lap});
  AddQuads("room", 0, walls, scene);
  AddQuads("neighbour", 2, BoxQuads({4, 0, -4}, {8, 5, 4}), scene);
  PunctualLight sun;
  sun.name = "sun";
  sun.kind = PunctualKind::kDirectional;
  sun.direction = Normalize(Vec3d(0.5, -1, -0.4));
  sun.intensity = Rgb(10, 10, 9);
  scene.lights.push_back(sun);
  scene.environment.sky = Rgb(0.5f, 0.6f, 0.8f);
  scene.cameras = {MakeCamera("inside", {-1.6, 1.6, -1.6}, {2, 1.2, 2}),
                   MakeCamera("outside", {2.6, 1.6, 7}, {2.8, 1, 0})};
  return scene;
}

Scene MakeSplitRoom(double t) {
  Scene scene;
  scene.name = "split room";
  scene.materials = {LambertMaterial("plaster", Rgb(0.8f)),
                     LambertMaterial("lamp", Rgb(0.0f), Rgb(10, 10, 9))};
  AddQuads("box", 0, BoxQuads({-4, 0, -2}, {4, 3, 2}), scene);
  // Into the box's walls, so that no crack is left.
  AddQuads("wall", 0, WallQuads({-0.5 * t, -0.05, -2.05}, {0.5 * t, 3.05, 2.05}), scene);
  AddQuads("lamp", 1, {{{{2, 2.9f, -0.5f}, {3, 2.9f, -0.5f}, {3, 2.9f, 0.5f}, {2, 2.9f, 0.5f}}}},
           scene);
  scene.cameras = {MakeCamera("dark", {-3.6, 1.6, -1.2}, {0, 1.4, 0.3}),
                   MakeCamera("lit", {3.6, 1.6, -1.2}, {0, 1.4, 0.3})};
  return scene;
}

absl::StatusOr<AccuracyCheck> CheckLeak(std::string_view name, const AccuracyContext& context) {
  const AccuracyOptions& options = context.options;
  const bool room = name == "leak-room";
  const RenderSettings settings = MeasuredSettings(options);
  const int side = options.quick ? 48 : 192;
  AccuracyCheck check;
  check.name = name;
  check.setup = room ? "a closed room of 4 x 3 x 4 m in sun and sky; inside over the mean outside"
                     : "a closed box halved by a thin wall, a lamp on one side; the dark half over "
                       "the mean of the lit one";
  const double bar = room ? kRoomBar : kWallBar;

  std::vector<std::pair<std::string, Scene>> scenes;
  if (room) {
    scenes.emplace_back("walls of 0.2 m", MakeDarkRoom(0.2));
    scenes.emplace_back("walls without thickness", MakeDarkRoom(0));
  } else {
    FP_ASSIGN_OR_RETURN(const float spacing,
                        SurfelSpacing(MakeSplitRoom(0), settings, context.executor));
    const double thin = 0.25 * static_cast<double>(spacing);
    scenes.emplace_back(absl::StrFormat("wall of %.2g m, a quarter of the surfels' spacing", thin),
                        MakeSplitRoom(thin));
    scenes.emplace_back("wall without thickness", MakeSplitRoom(0));
  }
  for (const auto& [what, scene] : scenes) {
    FP_ASSIGN_OR_RETURN(
        const LoadedFrame loaded,
        LoadFrame(scene, scene.cameras[0], side, side, settings, &context.cache, context.executor));
    FP_ASSIGN_OR_RETURN(const Lit dark,
                        Irradiance(loaded, scene.cameras[0], settings, context.executor));
    FP_ASSIGN_OR_RETURN(const Lit lit,
                        Irradiance(loaded, scene.cameras[1], settings, context.executor));
    if (!(lit.mean > 0)) {
      return absl::InternalError(Concat({name, ": its lit side is dark; a defect of farpoint"}));
    }
    check.values.push_back({what + ": largest", dark.max / lit.mean, 0, bar});
    check.values.push_back({what + ": mean", dark.mean / lit.mean, 0, bar});
    if (!options.pictures || !check.pictures.empty()) continue;
    const float white = LuminanceQuantile(lit.film, Layer::kBeauty, 0.97);
    Picture seen = ColourPicture(lit.film, Layer::kBeauty, white);
    check.pictures.push_back({"The lit side", what, Concat({name, "-lit.png"}), seen.width,
                              seen.height, std::move(seen.rgb)});
    const float bright = static_cast<float>(bar * lit.mean);
    Picture leak = FalseColourPicture(dark.film, Layer::kIrradiance, bright);
    check.pictures.push_back({"The dark side", "irradiance; white is the bar",
                              Concat({name, "-dark.png"}), leak.width, leak.height,
                              std::move(leak.rgb)});
  }
  return check;
}

}  // namespace farpoint
