#include "bench/stability.h"

#include <algorithm>
#include <array>
#include <bit>
#include <chrono>
#include <cmath>
#include <filesystem>
#include <limits>
#include <map>
#include <memory>
#include <optional>
#include <utility>

#include "absl/strings/str_format.h"
#include "bench/accuracy_checks.h"
#include "bench/accuracy_frame.h"
#include "bench/bench_scene.h"
#include "bench/machine.h"
#include "bench/sparse_reference.h"
#include "bench/stability_scenes.h"
#include "bench/text.h"
#include "core/base/executor.h"
#include "core/image/film.h"
#include "core/math/elementary.h"
#include "core/pbgi/surfel_sampler.h"
#include "core/render/bake.h"
#include "core/render/frame_renderer.h"
#include "core/scene/procedural.h"

namespace farpoint {

namespace {

constexpr std::array kIntegrators = {Integrator::kFpbgi, Integrator::kPbgi, Integrator::kPt};
constexpr size_t kShots = kIntegrators.size();
constexpr size_t kFpbgi = 0, kPbgi = 1, kPt = 2;
// No seed that a user is likely to render with.
constexpr uint64_t kReferenceSeed = 0x9e3779b97f4a7c15ull;
constexpr uint64_t kPixelSeed = 20130715;

constexpr double kSameRr = 1e-3;  // another unit or place: DESIGN, numerical contract
constexpr double kMoreError = 1.5;
constexpr double kBiasMoves = 0.01;
constexpr double kLeak = 0.005;  // of the lit side

struct Size {
  int width, height;
};

// One frame by each integrator: indirect and direct irradiance, and depth.
struct Shots {
  std::array<Film, kShots> film;
};

// A scene as it is, its frames, and the truth at some of its pixels.
struct Base {
  std::string name;
  StabilityScene source;
  Size size;
  Shots shots;
  std::vector<PixelPosition> pixels;  // where the truth is known
  std::vector<Rgb> truth;             // indirect irradiance, W/m²
  double noise = 0;                   // of the truth, over its mean
  double diagonal_m = 0;
};

// Bars on errors against the truth: rr by integrator, and |bias|. kAny: that it is finite is all
// that is asked of an integrator that cannot be right there, such as points further apart than what
// is looked at.
constexpr double kAny = -1;
struct ErrorBars {
  std::array<double, kShots> rr;
  double bias;
};

bool IsBackground(const Film& film, size_t i) {
  return !std::isfinite(film.Plane(Layer::kDepth, 0)[i]);
}

constexpr std::array kLayersOfLight = {Layer::kIrradiance, Layer::kDirectIrradiance};

// Values that no kernel may make: not finite or negative.
size_t BadValues(const Film& film) {
  size_t bad = 0;
  for (const Layer layer : kLayersOfLight) {
    for (int c = 0; c < 3; ++c) {
      for (const float v : film.Plane(layer, c)) bad += !(v >= 0 && std::isfinite(v));
    }
  }
  return bad;
}

size_t DifferentBits(const Film& a, const Film& b) {
  size_t differ = 0;
  for (const Layer layer : kLayersOfLight) {
    for (int c = 0; c < 3; ++c) {
      const auto pa = a.Plane(layer, c), pb = b.Plane(layer, c);
      for (size_t i = 0; i < pa.size(); ++i) {
        differ += std::bit_cast<uint32_t>(pa[i]) != std::bit_cast<uint32_t>(pb[i]);
      }
    }
  }
  return differ;
}

// Root mean square difference over the mean of `b`.
double RelativeRmse(const Film& a, const Film& b, Layer layer) {
  double square = 0, sum = 0, n = 0;
  for (int c = 0; c < 3; ++c) {
    const auto pa = a.Plane(layer, c), pb = b.Plane(layer, c);
    for (size_t i = 0; i < pa.size(); ++i) {
      const double d = static_cast<double>(pa[i]) - static_cast<double>(pb[i]);
      square += d * d;
      sum += static_cast<double>(pb[i]);
      n += 1;
    }
  }
  return sum > 0 ? std::sqrt(square * n) / sum : std::sqrt(square);
}

double LargestIrradiance(const Film& film, Layer layer) {
  double largest = 0;
  for (int c = 0; c < 3; ++c) {
    for (const float v : film.Plane(layer, c)) largest = std::max(largest, static_cast<double>(v));
  }
  return largest;
}

struct Mean {
  double mean = 0, max = 0;
  size_t pixels = 0;
};
// Over pixels that see a surface, of the largest channel.
Mean MeanIrradiance(const Film& film) {
  Mean out;
  const size_t n = film.Plane(Layer::kIrradiance, 0).size();
  for (size_t i = 0; i < n; ++i) {
    if (IsBackground(film, i)) continue;
    double e = 0;
    for (int c = 0; c < 3; ++c) {
      e = std::max(e, static_cast<double>(film.Plane(Layer::kIrradiance, c)[i]));
    }
    out.mean += e;
    out.max = std::max(out.max, e);
    ++out.pixels;
  }
  if (out.pixels > 0) out.mean /= static_cast<double>(out.pixels);
  return out;
}

class Runner {
 public:
  Runner(const StabilityOptions& options, const std::function<void(std::string_view)>& progress,
         StabilityReport& report)
      : options_(options), progress_(progress), report_(report), executor_(options.threads) {
    report_.threads = executor_.threads();
  }

  // --- Invariance ---

  absl::Status ScaleByPowersOfTwo() {
    return ForScenes("invariance", "the same bits as unscaled", [&](const Base& base) {
      for (const int exponent : {10, 20, 40, -12, -24, -30}) {
        const double scale = std::exp2(exponent);
        if (!(base.diagonal_m * scale > 0x1p-30)) continue;  // refused: see "too-large"
        FP_RETURN_IF_ERROR(SameBits(base, Transformed(base.source, ScalingBy(scale), scale),
                                    absl::StrFormat("scale 2^%d", exponent)));
      }
      return absl::OkStatus();
    });
  }

  absl::Status ScaleByThousands() {
    return ForScenes("invariance", "rr against the frame at scale 1", [&](const Base& base) {
      for (const double scale : {1e-3, 1e3}) {
        FP_RETURN_IF_ERROR(SamePixels(base, Transformed(base.source, ScalingBy(scale), scale),
                                      absl::StrFormat("scale %g", scale)));
      }
      return absl::OkStatus();
    });
  }

  absl::Status Translate() {
    return ForScenes("invariance", "rr against the frame at the origin", [&](const Base& base) {
      for (const double diagonals : {1e2, 1e4, 1e6}) {
        const Vec3d offset = Normalize(Vec3d(1, 0.7, -0.4)) * (diagonals * base.diagonal_m);
        FP_RETURN_IF_ERROR(SamePixels(base, Transformed(base.source, TranslationBy(offset), 1),
                                      absl::StrFormat("moved by %g diagonals", diagonals)));
      }
      return absl::OkStatus();
    });
  }

  absl::Status Rotate() {
    return ForScenes("invariance", kTruthCheck, [&](const Base& base) {
      for (const double degrees : {37.0, 161.0}) {
        const Affine world = RotationAbout({1, 2, 3}, degrees * kPi / 180);
        FP_RETURN_IF_ERROR(SameError(base, Transformed(base.source, world, 1),
                                     absl::StrFormat("turned by %g°", degrees)));
      }
      return absl::OkStatus();
    });
  }

  absl::Status Mirror() {
    return ForScenes("invariance", kTruthCheck, [&](const Base& base) {
      return SameError(base, Transformed(base.source, MirroringX(), 1), "mirrored");
    });
  }

  absl::Status Permute() {
    return ForScenes("invariance", kTruthCheck, [&](const Base& base) {
      return SameError(base, {Permuted(base.source.scene, 7), base.source.camera}, "permuted");
    });
  }

  absl::Status SplitMeshes() {
    return ForScenes("invariance", kTruthCheck, [&](const Base& base) {
      return SameError(base, {Split(base.source.scene), base.source.camera}, "split");
    });
  }

  // What lies far away, however far, changes nothing here.
  absl::Status Strays() {
    return OnCornell(
        "invariance",
        Concat({"an object or a black ground that reaches far beyond the box, which itself is not ",
                "changed: ", kTruthCheck}),
        [&](const Base& base) {
          const StabilityScene& source = base.source;
          for (const double away_m : {1e3, 1e5, 1e7, 1e12}) {
            FP_RETURN_IF_ERROR(SameError(
                base, {WithStray(source.scene, Vec3d(0.3, -0.5, 0.8) * away_m), source.camera},
                absl::StrFormat("a triangle %g m away", away_m)));
          }
          for (const double half_m : {1e3, 1e5}) {
            const StabilityScene on_ground = {WithBlackGround(source.scene, half_m, -0.1),
                                              source.camera};
            FP_RETURN_IF_ERROR(
                SameError(base, on_ground, absl::StrFormat("a ground of +-%g m", half_m)));
          }
          const Affine slope = RotationAbout({1, 2, 3}, 37 * kPi / 180);
          return SameError(
              base,
              Transformed({WithBlackGround(source.scene, 1e3, -0.1), source.camera}, slope, 1),
              "a ground of +-1000 m, all turned by 37°");
        });
  }

  // --- Degenerate geometry ---

  absl::Status FlatTriangles() {
    return ForScenes(
        "geometry",
        Concat({"meshes without area: the same bits as without; flat triangles within ",
                "meshes: ", kTruthCheck}),
        [&](const Base& base) {
          FP_RETURN_IF_ERROR(SameBits(base, {WithFlatMeshes(base.source.scene), base.source.camera},
                                      "flat meshes"));
          return SameError(base, {WithFlatTriangles(base.source.scene), base.source.camera},
                           "flat triangles");
        });
  }

  absl::Status Needles() {
    return ForScenes("geometry", kTruthCheck, [&](const Base& base) {
      return SameError(base, {WithNeedles(base.source.scene), base.source.camera},
                       "needles of 1 : 10^6");
    });
  }

  absl::Status Duplicates() {
    // Emitters too would be there twice, and their light is not asked to be the same.
    return OnCornell("geometry", kTruthCheck, [&](const Base& base) {
      Scene twice = base.source.scene;
      for (const Instance& instance : base.source.scene.instances) {
        if (instance.name != "light") twice.instances.push_back(instance);
      }
      // Each of the two has as many surfels as before.
      return SameError(base, {std::move(twice), base.source.camera}, "all surfaces twice",
                       [&](RenderSettings& settings) { settings.points *= 2; });
    });
  }

  absl::Status Sheets() {
    return OnOwn("geometry", "sheets in the box", SheetsInTheBox(), Square(),
                 {{0.06, 0.12, 0.1}, 0.03});
  }

  absl::Status Normals() {
    const std::string check = Concat(
        {"normals of other lengths: the same bits as with unit normals; none, or opposed ones: ",
         kTruthCheck});
    return OnCornell("geometry", check, [&](const Base& base) {
      const auto with = [&](BadNormals kind) {
        return StabilityScene{WithNormals(base.source.scene, kind), base.source.camera};
      };
      FP_ASSIGN_OR_RETURN(
          const Shots unit,
          Shoot({WithFlatNormals(base.source.scene), base.source.camera}, base.size));
      for (const auto& [kind, name] : {std::pair(BadNormals::kLong, "normals of 2^100"),
                                       std::pair(BadNormals::kTiny, "normals of 2^-100")}) {
        FP_ASSIGN_OR_RETURN(const Shots shots, Shoot(with(kind), base.size));
        AddBits(shots, unit, name);
      }
      for (const auto& [kind, name] :
           {std::pair(BadNormals::kZero, "zero normals"),
            std::pair(BadNormals::kNan, "NaN in normals"),
            std::pair(BadNormals::kInfinite, "infinities in normals"),
            std::pair(BadNormals::kOpposed, "normals that oppose their faces")}) {
        FP_RETURN_IF_ERROR(SameError(base, with(kind), name));
      }
      return absl::OkStatus();
    });
  }

  absl::Status TinyTriangles() {
    const unsigned side = options_.quick ? 100 : 708;  // 708: a million triangles
    return OnOwn("geometry",
                 absl::StrFormat("%d triangles of a millimetre on two of 2 km", 2 * side * side),
                 TinyBesideHuge(side), Square(), {{0.1, kAny, 0.4}, 0.1});
  }

  absl::Status TooLarge() {
    Start("geometry", "cornell", "1 if it is not refused with a clear error");
    const StabilityScene box{MakeCornellBox(), MakeCornellBox().cameras.front()};
    const auto refused = [&](const StabilityScene& source, const std::string& what,
                             std::string_view says) {
      const absl::StatusOr<Shots> shots = Shoot(source, {4, 4});
      const bool good = absl::IsInvalidArgument(shots.status()) &&
                        std::string(shots.status().message()).find(says) != std::string::npos;
      Add("scene", what, good ? 0 : 1, 0, 0);
    };
    for (const float size : {1e38f, std::numeric_limits<float>::max()}) {
      StabilityScene far = box;
      far.scene.meshes[0].positions[0] = Vec3f(size, -size, size);
      refused(far, absl::StrFormat("a corner at %g m", size), "across");
    }
    StabilityScene nan = box;
    nan.scene.meshes[1].positions[0].x = std::numeric_limits<float>::quiet_NaN();
    refused(nan, "a corner that is NaN", "vertex 0");
    refused(Transformed(box, ScalingBy(0x1p-40), 0x1p-40), "a box of 2^-37 m", "scale it up");
    StabilityScene transform = box;
    transform.scene.instances[0].world_from_mesh.translation.y =
        std::numeric_limits<double>::infinity();
    refused(transform, "an infinite transform", "not finite");
    StabilityScene colour = box;
    colour.scene.materials[0].emission.x = std::numeric_limits<float>::quiet_NaN();
    refused(colour, "an emission that is NaN", "emission");
    return Finish();
  }

  // --- Lights and cameras ---

  absl::Status FlatEmitters() {
    return OnCornell("lights and cameras", "the same bits as without", [&](const Base& base) {
      StabilityScene source = base.source;
      Mesh flat = source.scene.meshes[2];  // the light
      flat.name = "flat emitter";
      for (Vec3f& p : flat.positions) p = Vec3f(1, 1, 1 + p.x);
      source.scene.instances.push_back(
          {"flat emitter", static_cast<uint32_t>(source.scene.meshes.size()), {}});
      source.scene.meshes.push_back(std::move(flat));
      return SameBits(base, source, "an emitter without area");
    });
  }

  absl::Status LightsOnSurfaces() {
    const StabilityScene box{MakeCornellBox(), MakeCornellBox().cameras.front()};
    FP_ASSIGN_OR_RETURN(const Vec3d surfel, SomeSurfel(box.scene));
    const std::pair<Vec3d, const char*> places[] = {{{1.0, 0.0, 4.0}, "on the floor"},
                                                    {{3.6, 1.5, 3.5}, "inside the tall box"},
                                                    {{1.3, 1.65, 0.65}, "at a vertex"},
                                                    {surfel, "at a surfel"},
                                                    {{2.0, 2.7, 1.5}, "in the open"}};
    Start("lights and cameras", "cornell",
          "rr and bias against pt with many paths, and no value that is not finite or negative");
    for (const auto& [place, name] : places) {
      StabilityScene lit = box;
      PunctualLight light;
      light.name = name;
      light.position = place;
      light.intensity = Rgb(20, 18, 15);
      lit.scene.lights = {light};
      FP_RETURN_IF_ERROR(
          AgainstTruth(lit, Square(), {{0.1, 0.25, 0.25}, 0.05}, Concat({"a light ", name})));
    }
    return Finish();
  }

  absl::Status BrightAndDim() {
    Start("lights and cameras", "cornell; two furnaces",
          "against pt with many paths; the furnaces against their closed form");
    StabilityScene box{MakeCornellBox(), MakeCornellBox().cameras.front()};
    box.scene.materials[3].emission = Rgb(1e6f);
    Mesh dim = box.scene.meshes[2];
    for (Vec3f& p : dim.positions) p.y = 0.01f;
    dim.material = static_cast<int32_t>(box.scene.materials.size());
    box.scene.materials.push_back(box.scene.materials[3]);
    box.scene.materials.back().emission = Rgb(1e-6f);
    box.scene.instances.push_back({"dim", static_cast<uint32_t>(box.scene.meshes.size()), {}});
    box.scene.meshes.push_back(std::move(dim));
    FP_RETURN_IF_ERROR(
        AgainstTruth(box, Square(), {{0.06, 0.12, 0.1}, 0.03}, "emitters of 10^6 and 10^-6"));
    for (const auto& [bright, own] : {std::pair(1e-6f, 1e6f), std::pair(1e6f, 1e-6f)}) {
      FP_ASSIGN_OR_RETURN(const Shots shots, Shoot(BrightBesideDim(bright, own), Square()));
      const double expected = kPi * 0.5 * static_cast<double>(own);
      for (size_t i = 0; i < kShots; ++i) {
        AddFinite(shots.film[i], i, absl::StrFormat("in a room of %g", own));
        // Light is drawn by power: samples of the dim room's walls are none among 10^12 there.
        if (own < bright) continue;
        Add(NameOf(kIntegrators[i]),
            absl::StrFormat("in a room of %g beside one of %g: error of the mean", own, bright),
            std::fabs(MeanIrradiance(shots.film[i]).mean / expected - 1), 0,
            // The noise of few surfels, of four rays each.
            options_.quick ? 0.02 : 0.01);
      }
    }
    return Finish();
  }

  absl::Status CamerasInWalls() {
    Start("lights and cameras", "cornell",
          "inside the closed box: E over the mean of the room; on surfaces: against pt");
    const StabilityScene box{MakeCornellBox(), MakeCornellBox().cameras.front()};
    FP_ASSIGN_OR_RETURN(const Base* room, GetCornell());
    for (size_t i = 0; i < kShots; ++i) {
      StabilityScene inside = box;
      inside.camera = CameraAt({3.6, 1.5, 3.5}, {2.5, 1.2, 2.5}, 70);
      FP_ASSIGN_OR_RETURN(const Film film, Shoot(inside, Square(), i));
      AddFinite(film, i, "inside the tall box");
      Add(NameOf(kIntegrators[i]), "inside the tall box: largest E over the room's mean",
          LargestIrradiance(film, Layer::kIrradiance) / MeanIrradiance(room->shots.film[kPt]).mean,
          0, kLeak);
    }
    const std::pair<Vec3d, const char*> eyes[] = {{{2.0, 0.0, 3.0}, "on the floor"},
                                                  {{0, 0, 5.592}, "at a corner"},
                                                  {{1.3, 1.65, 0.65}, "at a vertex of a box"}};
    for (const auto& [eye, name] : eyes) {
      StabilityScene on = box;
      on.camera = CameraAt(eye, {2.9, 2.5, 2.4}, 70);
      FP_RETURN_IF_ERROR(
          AgainstTruth(on, Square(), {{0.1, 0.2, 0.15}, 0.05}, Concat({"a camera ", name})));
    }
    return Finish();
  }

  absl::Status SmallImages() {
    Start("lights and cameras", "cornell",
          "a crop of one pixel and of the frame's last one: the same bits as in the frame; small "
          "images: no value that is not finite or negative");
    const StabilityScene box{MakeCornellBox(), MakeCornellBox().cameras.front()};
    for (const Size size : {Size{1, 1}, Size{1, 77}, Size{77, 1}, Size{33, 33}}) {
      FP_ASSIGN_OR_RETURN(const Shots shots, Shoot(box, size));
      for (size_t i = 0; i < kShots; ++i) {
        AddFinite(shots.film[i], i, absl::StrFormat("%dx%d", size.width, size.height));
      }
      if (size.width != 33) continue;
      for (const PixelRect crop : {PixelRect{17, 11, 18, 12}, PixelRect{32, 32, 33, 33}}) {
        for (size_t i = 0; i < kShots; ++i) {
          FP_ASSIGN_OR_RETURN(const Film part, Shoot(box, size, i, {}, crop));
          Film cut(crop, {part.layers().begin(), part.layers().end()});
          cut.Paste(shots.film[i]);
          Add(NameOf(kIntegrators[i]),
              absl::StrFormat("crop of pixel %d,%d: values whose bits differ", crop.x0, crop.y0),
              static_cast<double>(DifferentBits(part, cut)), 0, 0);
        }
      }
    }
    return Finish();
  }

  // --- The algorithm's own corners ---

  absl::Status ContactCase() {
    return OnOwn("algorithm", "a box on a floor, close", Contact(), Square(),
                 {{0.08, 0.25, 0.15}, 0.06});
  }

  absl::Status OwnPlane() {
    Start("algorithm", "one plane", "the plane's largest E over what it reflects, pi B");
    FP_ASSIGN_OR_RETURN(const Shots shots, Shoot(OnePlane(), Square()));
    for (size_t i = 0; i < kShots; ++i) {
      AddFinite(shots.film[i], i, "one plane");
      const double reflected = 0.8 * LargestIrradiance(shots.film[i], Layer::kDirectIrradiance);
      Add(NameOf(kIntegrators[i]), "light from one's own plane",
          reflected > 0 ? LargestIrradiance(shots.film[i], Layer::kIrradiance) / reflected
                        : std::numeric_limits<double>::quiet_NaN(),
          0, 1e-6);
    }
    return Finish();
  }

  absl::Status ThinWall() {
    Start("algorithm", "a box halved by a wall",
          "E of the dark half over the mean of the lit one; the truth is 0");
    RenderSettings settings = Settings();
    FP_ASSIGN_OR_RETURN(const float spacing, SurfelSpacing(MakeSplitRoom(0), settings, executor_));
    const std::pair<double, const char*> walls[] = {
        {0, "no thickness"},
        {0.1 * static_cast<double>(spacing), "a tenth of the surfels' spacing"}};
    for (const auto& [thickness, name] : walls) {
      const Scene scene = MakeSplitRoom(thickness);
      FP_ASSIGN_OR_RETURN(const Shots dark, Shoot({scene, scene.cameras[0]}, Square()));
      FP_ASSIGN_OR_RETURN(const Shots lit, Shoot({scene, scene.cameras[1]}, Square()));
      for (size_t i = 0; i < kShots; ++i) {
        AddFinite(dark.film[i], i, name);
        const double scale = MeanIrradiance(lit.film[i]).mean;
        const Mean leak = MeanIrradiance(dark.film[i]);
        // pbgi draws discs, which reach over an edge by up to their radius: its largest value is
        // that of single pixels beside the wall.
        Add(NameOf(kIntegrators[i]), Concat({"a wall of ", name, ": mean leak"}), leak.mean / scale,
            0, kLeak);
        if (i != kPbgi) {
          Add(NameOf(kIntegrators[i]), Concat({"a wall of ", name, ": largest leak"}),
              leak.max / scale, 0, kLeak);
        }
      }
    }
    return Finish();
  }

  absl::Status CancellingNormals() {
    return OnOwn("algorithm", "leaves and balls", Leaves(options_.quick ? 400 : 4000, 3), Square(),
                 {{0.15, 0.35, 0.15}, 0.1});
  }

  absl::Status ClustersAndEpsilon() {
    return OnCornell(
        "algorithm", "k means clusters of the paper: rr against pbgi, with the same buffers",
        [&](const Base& base) {
          const auto shoot = [&](uint32_t k, float epsilon) {
            return Shoot(base.source, base.size, kFpbgi, [&](RenderSettings& s) {
              s.clusters = k;
              s.epsilon = epsilon;
            });
          };
          struct Setting {
            uint32_t k;
            float epsilon;
            const char* what;
            double bar;
          };
          // Every receiver a cluster, or every node near: what is left is pbgi. One cluster for a
          // block and nothing near is as coarse as it gets: only that it is finite counts.
          const Setting settings[] = {{1024, 0.2f, "k beyond the block's receivers", 0.01},
                                      {1024, 0.0f, "k beyond the receivers, epsilon 0", 0.01},
                                      {8, 0.0f, "epsilon 0", 0.1},
                                      {1, 1e30f, "one cluster, epsilon without bound", 1.0},
                                      {8, 1e30f, "k 8, epsilon without bound", 1.0}};
          for (const Setting& s : settings) {
            FP_ASSIGN_OR_RETURN(const Film film, shoot(s.k, s.epsilon));
            AddFinite(film, kFpbgi, s.what);
            Add("fpbgi", Concat({s.what, ": rr against pbgi"}),
                RelativeRmse(film, base.shots.film[kPbgi], Layer::kIrradiance), 0, s.bar);
          }
          return absl::OkStatus();
        });
  }

  absl::Status Buffers() {
    Start("algorithm", "cornell",
          "no value that is not finite or negative; 64² and 256²: rr against pt is at most 1.5 "
          "times that of 32²");
    // Few receivers: a buffer of 256² is 64 times the work of one of 32².
    FP_ASSIGN_OR_RETURN(
        const Base base,
        MakeBase("cornell, small", {MakeCornellBox(), MakeCornellBox().cameras.front()}, {16, 16}));
    std::array<double, kShots> before{};
    for (const uint32_t side : {32u, 1u, 2u, 64u, 256u}) {
      if (side == 256 && options_.quick) continue;
      for (const size_t i : {kFpbgi, kPbgi}) {
        FP_ASSIGN_OR_RETURN(const Film film,
                            Shoot(base.source, base.size, i, [&](RenderSettings& s) {
                              s.microbuffer = side;
                              if (i == kFpbgi) s.clusters = 50;
                            }));
        const std::string what = absl::StrFormat("buffers of %d²", side);
        AddFinite(film, i, what);
        if (side < 32) continue;
        const double rr = ErrorOf(film, base).rr;
        if (side == 32) {
          before[i] = rr;
          continue;
        }
        Add(NameOf(kIntegrators[i]), Concat({what, ": rr against pt"}), rr, base.noise,
            kMoreError * before[i]);
      }
    }
    return Finish();
  }

  absl::Status FewSurfels() {
    Start("algorithm", "cornell; an empty scene",
          "no value that is not finite or negative; nothing to gather from: dark");
    const StabilityScene box{MakeCornellBox(), MakeCornellBox().cameras.front()};
    for (const uint64_t points : {1u, 2u, 9u}) {
      for (const size_t i : {kFpbgi, kPbgi}) {
        FP_ASSIGN_OR_RETURN(const Film film,
                            Shoot(box, {24, 24}, i, [&](RenderSettings& s) { s.points = points; }));
        AddFinite(film, i, absl::StrFormat("--points %d", points));
      }
    }
    StabilityScene empty = box;
    empty.scene.instances.clear();
    FP_ASSIGN_OR_RETURN(const Shots none, Shoot(empty, {24, 24}));
    StabilityScene dark = box;
    for (Material& m : dark.scene.materials) m.emission = {};
    FP_ASSIGN_OR_RETURN(const Shots unlit, Shoot(dark, {24, 24}));
    for (size_t i = 0; i < kShots; ++i) {
      Add(NameOf(kIntegrators[i]), "no triangle: largest E",
          LargestIrradiance(none.film[i], Layer::kIrradiance) +
              static_cast<double>(BadValues(none.film[i])),
          0, 0);
      Add(NameOf(kIntegrators[i]), "no light: largest E",
          LargestIrradiance(unlit.film[i], Layer::kIrradiance) +
              static_cast<double>(BadValues(unlit.film[i])),
          0, 0);
    }
    return Finish();
  }

  // --- Sums ---

  absl::Status Threads() {
    return ForScenes("sums", "the same bits as with all threads", [&](const Base& base) {
      for (const unsigned threads : {1u, 3u}) {
        Executor executor(threads);
        FP_ASSIGN_OR_RETURN(const Shots shots, ShootOn(executor, base.source, base.size));
        AddBits(shots, base.shots, absl::StrFormat("%d threads", threads));
      }
      return absl::OkStatus();
    });
  }

  absl::Status FurnaceSums() {
    Start("sums", "furnace", "mean E against pi rho L; pt by so many paths in all");
    const Scene furnace = MakeFurnace(0.3f, 0.7f);
    const double expected = kPi * static_cast<double>(0.3f) * static_cast<double>(0.7f);
    const uint32_t paths = options_.quick ? 1u << 13 : 1u << 20;
    const Size size = options_.quick ? Size{8, 8} : Size{10, 10};
    for (size_t i = 0; i < kShots; ++i) {
      FP_ASSIGN_OR_RETURN(const Film film,
                          Shoot({furnace, furnace.cameras[0]}, i == kPt ? size : Square(), i,
                                [&](RenderSettings& s) { s.paths = paths; }));
      const uint64_t all = uint64_t{paths} * static_cast<uint64_t>(size.width * size.height);
      Add(NameOf(kIntegrators[i]),
          i == kPt ? absl::StrFormat("%d paths: error of the mean", all) : "error of the mean",
          std::fabs(MeanIrradiance(film).mean / expected - 1), 0,
          i != kPt         ? 0.01
          : options_.quick ? 1e-2
                           : 1e-4);
    }
    return Finish();
  }

 private:
  static constexpr const char* kTruthCheck =
      "rr against pt with many paths is at most 1.5 times that of the scene as it was, and the "
      "bias moves by at most a hundredth, three standard errors aside";

  Size Square() const { return options_.quick ? Size{24, 24} : Size{64, 64}; }

  RenderSettings Settings() const {
    RenderSettings s;
    s.points = options_.points;
    s.light_samples = options_.light_samples;
    s.seed = options_.seed;
    s.paths = options_.quick ? 64 : 256;
    s.layers = {Layer::kDepth, Layer::kIrradiance, Layer::kDirectIrradiance};
    return s;
  }

  // --- Rendering ---

  using Change = std::function<void(RenderSettings&)>;

  absl::StatusOr<Film> ShootOn(Executor& executor, const StabilityScene& source, Size size,
                               size_t i, const Change& change = {},
                               std::optional<PixelRect> crop = {}) {
    RenderSettings settings = Settings();
    settings.integrator = kIntegrators[i];
    if (change) change(settings);
    FP_ASSIGN_OR_RETURN(LoadedFrame loaded, LoadFrame(source.scene, source.camera, size.width,
                                                      size.height, settings, nullptr, executor));
    if (crop) loaded.frame.film.crop = *crop;
    FP_ASSIGN_OR_RETURN(RenderedFrame frame, RenderByTiles(loaded.frame, settings, executor));
    return std::move(frame.film);
  }
  absl::StatusOr<Film> Shoot(const StabilityScene& source, Size size, size_t i,
                             const Change& change = {}, std::optional<PixelRect> crop = {}) {
    return ShootOn(executor_, source, size, i, change, crop);
  }

  // All three from one bake.
  absl::StatusOr<Shots> ShootOn(Executor& executor, const StabilityScene& source, Size size,
                                const Change& change = {}) {
    RenderSettings settings = Settings();
    if (change) change(settings);
    FP_ASSIGN_OR_RETURN(const LoadedFrame loaded,
                        LoadFrame(source.scene, source.camera, size.width, size.height, settings,
                                  nullptr, executor));
    Shots shots;
    for (size_t i = 0; i < kShots; ++i) {
      settings.integrator = kIntegrators[i];
      FP_ASSIGN_OR_RETURN(RenderedFrame frame, RenderByTiles(loaded.frame, settings, executor));
      shots.film[i] = std::move(frame.film);
    }
    return shots;
  }
  absl::StatusOr<Shots> Shoot(const StabilityScene& source, Size size, const Change& change = {}) {
    return ShootOn(executor_, source, size, change);
  }

  absl::StatusOr<Base> MakeBase(std::string name, StabilityScene source, Size size) {
    progress_(Concat({name, ": as it is, and its truth"}));
    Base base{std::move(name), std::move(source), size, {}, {}, {}, 0, 0};
    FP_ASSIGN_OR_RETURN(base.shots, Shoot(base.source, size));
    RenderSettings settings = Settings();
    settings.integrator = Integrator::kPt;
    FP_ASSIGN_OR_RETURN(const LoadedFrame loaded,
                        LoadFrame(base.source.scene, base.source.camera, size.width, size.height,
                                  settings, nullptr, executor_));
    FP_ASSIGN_OR_RETURN(const auto prepared, PreparedScene::Prepare(base.source.scene, executor_));
    base.diagonal_m = static_cast<double>(prepared->diagonal_m());
    SparseReferenceOptions options;
    options.noise = 0.005;
    options.budget_s = options_.quick ? 0.5 : 60;
    options.min_paths = options_.quick ? 256 : 1024;
    options.direct_samples = 0;
    options.seed = kReferenceSeed;
    const std::vector<PixelPosition> pixels =
        StratifiedPixels(loaded.frame.film.crop, options_.quick ? 200 : 1000, kPixelSeed);
    FP_ASSIGN_OR_RETURN(
        const SparseReference reference,
        TraceSparseReference(loaded.frame, pixels, options, executor_, [](std::string_view) {}));
    for (size_t p = 0; p < pixels.size(); ++p) {
      if (!reference.hit[p]) continue;
      base.pixels.push_back(pixels[p]);
      base.truth.push_back(reference.Indirect(p));
    }
    base.noise = reference.IndirectNoise();
    return base;
  }

  // "cornell", "city" or "sponza"; null, with a line in the report, if it is not there.
  absl::StatusOr<const Base*> Get(const std::string& name) {
    if (const auto it = bases_.find(name); it != bases_.end()) return it->second.get();
    std::string source = name;
    SceneChanges changes;
    Size size = options_.quick ? Size{32, 32} : Size{96, 96};
    if (name != "cornell") size = {112, 80};
    if (name == "sponza") {
      source = (std::filesystem::path(options_.scenes_dir) / "sponza/Sponza.gltf").string();
      std::error_code error;
      if (options_.scenes_dir.empty() || !std::filesystem::exists(source, error)) {
        report_.left_out.push_back({name, options_.scenes_dir.empty()
                                              ? "no folder of scenes, give --scenes"
                                              : source + " is not there"});
        bases_[name] = nullptr;
        return nullptr;
      }
      changes.sun = AccuracySun{{0.3, 1, 0.1}, Rgb(10, 10, 10)};
      changes.view = AccuracyView{{9, 0.8, -0.3}, {-8, 4, -0.3}, 57};
    }
    FP_ASSIGN_OR_RETURN(BenchScene made, MakeBenchScene(source, true, changes));
    const Camera camera = made.scene.cameras.front();
    FP_ASSIGN_OR_RETURN(Base base, MakeBase(name, {std::move(made.scene), camera}, size));
    bases_[name] = std::make_unique<Base>(std::move(base));
    return bases_[name].get();
  }
  absl::StatusOr<const Base*> GetCornell() { return Get("cornell"); }

  absl::StatusOr<Vec3d> SomeSurfel(const Scene& scene) {
    FP_ASSIGN_OR_RETURN(const auto prepared, PreparedScene::Prepare(scene, executor_));
    const SurfelCloud cloud =
        SampleSurfels(scene, *prepared, options_.points, options_.seed, executor_);
    // The one on the floor that is nearest to a place beside both boxes.
    const Vec3d middle = Vec3d(4, 0, 1) - prepared->origin();
    const auto nearest = std::min_element(
        cloud.position.begin(), cloud.position.end(), [&](const Vec3f& a, const Vec3f& b) {
          return Length2(Vec3d(a) - middle) < Length2(Vec3d(b) - middle);
        });
    if (nearest == cloud.position.end()) return absl::InternalError("the box has no surfels");
    return Vec3d(*nearest) + prepared->origin();
  }

  // --- Figures ---

  void Start(std::string_view group, std::string_view scene, std::string_view check) {
    result_ = {};
    result_.name = case_;
    result_.group = group;
    result_.scene = scene;
    result_.check = check;
    start_ = std::chrono::steady_clock::now();
  }

  absl::Status Finish() {
    result_.seconds =
        std::chrono::duration<double>(std::chrono::steady_clock::now() - start_).count();
    progress_(absl::StrFormat("%s, %s: %d of %d figures above their bar, %.0f s", result_.name,
                              result_.scene, result_.failures(), result_.values.size(),
                              result_.seconds));
    report_.results.push_back(std::move(result_));
    return absl::OkStatus();
  }

  void Add(std::string_view integrator, std::string what, double value, double noise, double bar) {
    result_.values.push_back({std::string(integrator), std::move(what), value, noise, bar});
  }

  void AddFinite(const Film& film, size_t i, std::string_view what) {
    Add(NameOf(kIntegrators[i]), Concat({what, ": values not finite or negative"}),
        static_cast<double>(BadValues(film)), 0, 0);
  }

  void AddBits(const Shots& shots, const Shots& expected, std::string_view what) {
    for (size_t i = 0; i < kShots; ++i) {
      Add(NameOf(kIntegrators[i]), Concat({what, ": values whose bits differ"}),
          static_cast<double>(DifferentBits(shots.film[i], expected.film[i]) +
                              BadValues(shots.film[i])),
          0, 0);
    }
  }

  ErrorFigures ErrorOf(const Film& film, const Base& base) {
    return CompareSparse(ValuesAt(film, Layer::kIrradiance, base.pixels), base.truth, base.noise);
  }

  absl::Status SameBits(const Base& base, const StabilityScene& changed, std::string_view what) {
    FP_ASSIGN_OR_RETURN(const Shots shots, Shoot(changed, base.size));
    AddBits(shots, base.shots, what);
    return absl::OkStatus();
  }

  absl::Status SamePixels(const Base& base, const StabilityScene& changed, std::string_view what) {
    FP_ASSIGN_OR_RETURN(const Shots shots, Shoot(changed, base.size));
    for (size_t i = 0; i < kShots; ++i) {
      AddFinite(shots.film[i], i, what);
      Add(NameOf(kIntegrators[i]), Concat({what, ": rr"}),
          RelativeRmse(shots.film[i], base.shots.film[i], Layer::kIrradiance), 0, kSameRr);
    }
    Add("fpbgi", Concat({what, ": rr of direct light"}),
        RelativeRmse(shots.film[kFpbgi], base.shots.film[kFpbgi], Layer::kDirectIrradiance), 0,
        kSameRr);
    return absl::OkStatus();
  }

  absl::Status SameError(const Base& base, const StabilityScene& changed, std::string_view what,
                         const Change& change = {}) {
    FP_ASSIGN_OR_RETURN(const Shots shots, Shoot(changed, base.size, change));
    for (size_t i = 0; i < kShots; ++i) {
      AddFinite(shots.film[i], i, what);
      const ErrorFigures before = ErrorOf(base.shots.film[i], base);
      const ErrorFigures after = ErrorOf(shots.film[i], base);
      // Below the truth's noise there is nothing to grow by.
      Add(NameOf(kIntegrators[i]), Concat({what, ": rr against pt"}), after.rr, base.noise,
          kMoreError * std::max(before.rr, base.noise));
      Add(NameOf(kIntegrators[i]), Concat({what, ": the bias moves by"}),
          std::fabs(after.bias - before.bias), 0,
          kBiasMoves + 3 * std::hypot(before.bias_error, after.bias_error));
    }
    return absl::OkStatus();
  }

  absl::Status AgainstTruth(const StabilityScene& source, Size size, const ErrorBars& bars,
                            std::string_view what) {
    FP_ASSIGN_OR_RETURN(const Base base, MakeBase(std::string(what), source, size));
    double mean = 0;
    for (const Rgb& t : base.truth) mean += static_cast<double>(MaxComponent(t));
    if (!(mean > 0)) return absl::InternalError(Concat({what, ": nothing lit is seen"}));
    // Few surfels, few pixels and few paths are worth less.
    const double slack = options_.quick ? 2 : 1;
    for (size_t i = 0; i < kShots; ++i) {
      AddFinite(base.shots.film[i], i, what);
      if (bars.rr[i] == kAny) continue;
      const ErrorFigures e = ErrorOf(base.shots.film[i], base);
      Add(NameOf(kIntegrators[i]), Concat({what, ": rr against pt"}), e.rr, base.noise,
          slack * bars.rr[i]);
      Add(NameOf(kIntegrators[i]), Concat({what, ": bias, without its sign"}), std::fabs(e.bias), 0,
          slack * bars.bias + 3 * e.bias_error);
    }
    return absl::OkStatus();
  }

  // --- Cases on one scene or on all of them ---

  using Body = std::function<absl::Status(const Base&)>;

  absl::Status OnBase(const std::string& scene, std::string_view group, std::string_view check,
                      const Body& body) {
    FP_ASSIGN_OR_RETURN(const Base* base, Get(scene));
    if (base == nullptr) return absl::OkStatus();
    Start(group, scene, check);
    FP_RETURN_IF_ERROR(body(*base));
    return Finish();
  }

  absl::Status OnCornell(std::string_view group, std::string_view check, const Body& body) {
    return OnBase("cornell", group, check, body);
  }

  absl::Status ForScenes(std::string_view group, std::string_view check, const Body& body) {
    FP_RETURN_IF_ERROR(OnBase("cornell", group, check, body));
    if (options_.quick) return absl::OkStatus();
    FP_RETURN_IF_ERROR(OnBase("city", group, check, body));
    return OnBase("sponza", group, check, body);
  }

  absl::Status OnOwn(std::string_view group, std::string_view name, const StabilityScene& source,
                     Size size, const ErrorBars& bars) {
    Start(group, name, "rr and bias against pt with many paths");
    FP_RETURN_IF_ERROR(AgainstTruth(source, size, bars, name));
    return Finish();
  }

 public:
  void SetCase(std::string_view name) { case_ = name; }

 private:
  const StabilityOptions& options_;
  const std::function<void(std::string_view)>& progress_;
  StabilityReport& report_;
  Executor executor_;
  std::map<std::string, std::unique_ptr<Base>> bases_;
  std::string case_;
  StabilityResult result_;
  std::chrono::steady_clock::time_point start_;
};

struct Case {
  std::string_view name;
  absl::Status (Runner::*run)();
};

constexpr Case kCases[] = {
    {"scale-powers-of-two", &Runner::ScaleByPowersOfTwo},
    {"scale-thousands", &Runner::ScaleByThousands},
    {"translate", &Runner::Translate},
    {"rotate", &Runner::Rotate},
    {"mirror", &Runner::Mirror},
    {"permute", &Runner::Permute},
    {"split", &Runner::SplitMeshes},
    {"strays", &Runner::Strays},
    {"flat-triangles", &Runner::FlatTriangles},
    {"needles", &Runner::Needles},
    {"duplicates", &Runner::Duplicates},
    {"sheets", &Runner::Sheets},
    {"normals", &Runner::Normals},
    {"tiny-triangles", &Runner::TinyTriangles},
    {"refusals", &Runner::TooLarge},
    {"flat-emitters", &Runner::FlatEmitters},
    {"lights-on-surfaces", &Runner::LightsOnSurfaces},
    {"bright-and-dim", &Runner::BrightAndDim},
    {"cameras-in-walls", &Runner::CamerasInWalls},
    {"small-images", &Runner::SmallImages},
    {"contact", &Runner::ContactCase},
    {"own-plane", &Runner::OwnPlane},
    {"thin-wall", &Runner::ThinWall},
    {"cancelling-normals", &Runner::CancellingNormals},
    {"clusters-and-epsilon", &Runner::ClustersAndEpsilon},
    {"buffers", &Runner::Buffers},
    {"few-surfels", &Runner::FewSurfels},
    {"threads", &Runner::Threads},
    {"furnace-sums", &Runner::FurnaceSums},
};

}  // namespace

size_t StabilityResult::failures() const {
  return static_cast<size_t>(
      std::count_if(values.begin(), values.end(), [](const auto& v) { return !v.holds(); }));
}

size_t StabilityReport::failures() const {
  size_t sum = 0;
  for (const StabilityResult& r : results) sum += r.failures();
  return sum;
}

std::vector<std::string> StabilityNames() {
  std::vector<std::string> names;
  for (const Case& c : kCases) names.emplace_back(c.name);
  return names;
}

absl::StatusOr<StabilityReport> RunStability(
    const StabilityOptions& asked, const std::function<void(std::string_view)>& progress) {
  StabilityReport report;
  report.options = asked;
  StabilityOptions& options = report.options;
  if (options.points == 0) options.points = options.quick ? 2'500 : 20'000;
  if (options.cases.empty()) options.cases = StabilityNames();
  // Names first: a mistake should not cost the time of a bake.
  for (const std::string& name : options.cases) {
    if (std::none_of(std::begin(kCases), std::end(kCases),
                     [&](const Case& c) { return c.name == name; })) {
      std::string names;
      for (const Case& c : kCases) Append(names, {names.empty() ? "" : ", ", c.name});
      return absl::InvalidArgumentError(Concat({"--case ", name, " is none of ", names}));
    }
  }
  report.date_utc = DateUtc();
  report.cpu = CpuModel();
  report.load_average_start = LoadAverage();
  Runner runner(options, progress, report);
  for (const Case& c : kCases) {
    if (std::find(options.cases.begin(), options.cases.end(), c.name) == options.cases.end()) {
      continue;
    }
    runner.SetCase(c.name);
    FP_RETURN_IF_ERROR(Annotate((runner.*c.run)(), c.name));
  }
  report.load_average_end = LoadAverage();
  return report;
}

}  // namespace farpoint
