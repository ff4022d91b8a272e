#include "bench/lights.h"

#include <absl/strings/str_format.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <memory>
#include <nlohmann/json.hpp>
#include <utility>

#include "core/accel/ray_accel.h"
#include "core/base/executor.h"
#include "core/light/light_sampler.h"
#include "core/math/elementary.h"
#include "core/math/sampling.h"
#include "core/scene/procedural.h"

namespace farpoint {

namespace {

using Clock = std::chrono::steady_clock;

double SecondsSince(Clock::time_point start) {
  return std::chrono::duration<double>(Clock::now() - start).count();
}

// Numbers in [0, 1) by counting.
class Numbers {
 public:
  explicit Numbers(uint64_t seed) : seed_(seed) {}
  double Next() { return static_cast<double>(HashKey(seed_, ++count_) >> 11) * 0x1p-53; }
  double Between(double a, double b) { return a + (b - a) * Next(); }
  Vec3d InBox(const Vec3d& low, const Vec3d& high) {
    const double x = Between(low.x, high.x), y = Between(low.y, high.y);
    return {x, y, Between(low.z, high.z)};
  }

 private:
  uint64_t seed_, count_ = 0;
};

void AddQuad(Scene& scene, const Vec3d& a, const Vec3d& b, const Vec3d& c, const Vec3d& d,
             float radiance) {
  Mesh mesh;
  for (const Vec3d& v : {a, b, c, d}) mesh.positions.push_back(Vec3f(v));
  mesh.triangles = {{0, 1, 2}, {0, 2, 3}};
  mesh.material = static_cast<int32_t>(scene.materials.size());
  scene.materials.emplace_back().emission = Rgb(radiance);
  scene.instances.push_back({"quad", static_cast<uint32_t>(scene.meshes.size()), {}});
  scene.meshes.push_back(std::move(mesh));
}

// A floor of 20 m by 20 m with twelve walls.
Scene Yard() {
  Scene scene;
  AddQuad(scene, {-10, 0, 10}, {10, 0, 10}, {10, 0, -10}, {-10, 0, -10}, 0);
  Numbers random(1);
  for (int i = 0; i < 12; ++i) {
    const double x = random.Between(-8, 8), z = random.Between(-8, 8), h = random.Between(1, 3);
    AddQuad(scene, {x, 0, z}, {x + 1, 0, z + 0.5}, {x + 1, h, z + 0.5}, {x, h, z}, 0);
  }
  return scene;
}

float SomePower(Numbers& random) {
  return static_cast<float>(DetExp(random.Between(-3, 3) * 0.6931471805599453));
}

Scene PunctualYard(uint64_t count, PunctualKind kind) {
  Scene scene = Yard();
  Numbers random(2);
  for (uint64_t i = 0; i < count; ++i) {
    PunctualLight light;
    light.kind = kind;
    light.position = random.InBox({-9.5, 1.5, -9.5}, {9.5, 4, 9.5});
    light.direction = {0, -1, 0};
    light.inner_cone_rad = 0.6;
    light.outer_cone_rad = 1.0;
    light.range_m = kind == PunctualKind::kSpot ? 6 : 0;
    light.intensity = Rgb(SomePower(random));
    scene.lights.push_back(light);
  }
  return scene;
}

// `count` triangles, two by two.
Scene EmitterYard(uint64_t count) {
  Scene scene = Yard();
  Numbers random(3);
  for (uint64_t i = 0; i < count; i += 2) {
    const Vec3d c = random.InBox({-9.5, 1.5, -9.5}, {9.5, 4, 9.5});
    const Vec3d a = random.InBox(Vec3d(-0.05), Vec3d(0.05));
    const Vec3d b = random.InBox(Vec3d(-0.05), Vec3d(0.05));
    AddQuad(scene, c - a - b, c + a - b, c + a + b, c - a + b, SomePower(random));
  }
  return scene;
}

Scene MapYard(bool sun) {
  Scene scene = Yard();
  Environment& e = scene.environment;
  e.map_width = 1024;
  e.map_height = 512;
  for (uint32_t y = 0; y < e.map_height; ++y) {
    for (uint32_t x = 0; x < e.map_width; ++x) {
      const bool in_sun = sun && y / 2 == 64 && x / 2 == 100;
      e.map.push_back(in_sun ? Rgb(1e5f) : Rgb(1.0f - static_cast<float>(y) / 1024));
    }
  }
  return scene;
}

// Spread by area over what does not emit, or over all if everything emits; inside of closed rooms.
std::vector<SurfacePoint> Receivers(const RayAccel& accel, uint32_t count, bool room) {
  const PreparedScene& scene = accel.scene();
  std::vector<uint32_t> triangles;
  double area = 0;
  for (const bool any : {false, true}) {
    for (uint32_t t = 0; t < scene.triangles().size() && (!any || area == 0); ++t) {
      if (!any && MaxComponent(scene.MaterialOf(t).emission) > 0) continue;
      triangles.push_back(t);
      area += static_cast<double>(scene.TriangleArea(t));
    }
    if (area > 0) break;
  }
  std::vector<SurfacePoint> out;
  Numbers random(4);
  double below = 0;
  for (const uint32_t t : triangles) {
    below += static_cast<double>(scene.TriangleArea(t));
    while (out.size() < count && (static_cast<double>(out.size()) + 0.5) / count * area < below) {
      const Vec2f b =
          UniformTriangle(static_cast<float>(random.Next()), static_cast<float>(random.Next()));
      const Vec3f p = scene.PointOn(t, b.x, b.y);
      Vec3f n = scene.GeometricNormal(t);
      if (room ? Dot(p, n) > 0 : n.y < -0.5f) n = -n;
      out.push_back({p, n, n, accel.SurfaceOffsetM(t, p, n)});
    }
  }
  return out;
}

class Bench {
 public:
  explicit Bench(const LightsOptions& options) : options_(options) {}

  absl::StatusOr<LightsCase> Measure(const std::string& kind, uint64_t lights, const Scene& scene,
                                     bool room) {
    Executor executor(1);
    FP_ASSIGN_OR_RETURN(const auto prepared, PreparedScene::Prepare(scene, executor));
    FP_ASSIGN_OR_RETURN(const std::shared_ptr<const RayAccel> accel, RayAccel::Build(prepared));
    LightsCase out;
    out.kind = kind;
    out.lights = lights;
    const auto start = Clock::now();
    const LightSampler sampler(accel);
    out.prepare_s = SecondsSince(start);
    const std::vector<SurfacePoint> receivers = Receivers(*accel, options_.receivers, room);
    // Punctual lights all have a ray if there are as many samples.
    const auto reference_samples =
        static_cast<uint32_t>(scene.lights.empty() ? options_.reference_samples
                                                   : std::max<size_t>(scene.lights.size(), 1));
    std::vector<Vec3d> truth;
    double mean = 0;
    for (size_t i = 0; i < receivers.size(); ++i) {
      LightCounters unused;
      const SurfacePoint& r = receivers[i];
      truth.emplace_back(
          sampler.Irradiance(r, reference_samples, HashKey(options_.seed, 1, i), 0, 0, unused));
      mean += truth.back().y;
    }
    if (!(mean > 0)) return absl::InternalError(kind + ": nothing is lit");
    LightCounters counters;
    double square = 0, sum = 0;
    uint64_t estimates = 0;
    double seconds = 0;
    std::vector<Rgb> estimate(receivers.size());
    // At least some time, so that it means something.
    for (uint64_t round = 0; round == 0 || (seconds < 0.2 && !options_.quick); ++round) {
      const auto begin = Clock::now();
      for (size_t i = 0; i < receivers.size(); ++i) {
        const SurfacePoint& r = receivers[i];
        estimate[i] = sampler.Irradiance(r, options_.light_samples,
                                         HashKey(options_.seed, 2, round, i), 0, 0, counters);
      }
      seconds += SecondsSince(begin);
      for (size_t i = 0; i < receivers.size(); ++i) {
        const double d = static_cast<double>(estimate[i].y) - truth[i].y;
        square += d * d;
        sum += d;
      }
      estimates += receivers.size();
    }
    const auto n = static_cast<double>(estimates);
    mean /= static_cast<double>(receivers.size());
    out.rr = std::sqrt(square / n) / mean;
    out.bias = sum / n / mean;
    out.us_per_receiver = seconds * 1e6 / n;
    out.rays_per_receiver = static_cast<double>(counters.rays) / n;
    return out;
  }

 private:
  LightsOptions options_;
};

}  // namespace

absl::StatusOr<LightsReport> RunLights(const LightsOptions& given,
                                       const std::function<void(std::string_view)>& log) {
  LightsReport report;
  LightsOptions& options = report.options;
  options = given;
  if (options.quick) {
    options.receivers = std::min(options.receivers, 50u);
    options.reference_samples = std::min(options.reference_samples, 1024u);
  }
  Bench bench(options);
  const auto run = [&](const std::string& kind, uint64_t lights, const Scene& scene, bool room) {
    if (log) log(absl::StrFormat("%s, %d lights", kind, lights));
    absl::StatusOr<LightsCase> result = bench.Measure(kind, lights, scene, room);
    if (result.ok()) report.cases.push_back(*std::move(result));
    return result.status();
  };
  const uint64_t most = options.quick ? 100 : 10000;
  FP_RETURN_IF_ERROR(run("box", 2, MakeCornellBox(), true));
  FP_RETURN_IF_ERROR(run("furnace", 12, MakeFurnace(0.5f, 1), true));
  for (uint64_t n = 1; n <= most; n *= 10) {
    FP_RETURN_IF_ERROR(run("points", n, PunctualYard(n, PunctualKind::kPoint), false));
  }
  for (uint64_t n = 1; n <= most; n *= 10) {
    FP_RETURN_IF_ERROR(run("spots", n, PunctualYard(n, PunctualKind::kSpot), false));
  }
  for (uint64_t n = 2; n <= 2 * most; n *= 10) {
    FP_RETURN_IF_ERROR(run("emitters", n, EmitterYard(n), false));
  }
  FP_RETURN_IF_ERROR(run("map", 1024 * 512, MapYard(false), false));
  FP_RETURN_IF_ERROR(run("sun map", 1024 * 512, MapYard(true), false));
  return report;
}

std::string LightsJson(const LightsReport& report) {
  nlohmann::ordered_json json;
  json["farpoint_version"] = FARPOINT_VERSION;
  json["light_samples"] = report.options.light_samples;
  json["receivers"] = report.options.receivers;
  json["reference_samples"] = report.options.reference_samples;
  json["seed"] = report.options.seed;
  json["cases"] = nlohmann::ordered_json::array();
  for (const LightsCase& c : report.cases) {
    json["cases"].push_back({{"kind", c.kind},
                             {"lights", c.lights},
                             {"prepare_s", c.prepare_s},
                             {"us_per_receiver", c.us_per_receiver},
                             {"rays_per_receiver", c.rays_per_receiver},
                             {"rr", c.rr},
                             {"bias", c.bias}});
  }
  return json.dump(2) + "\n";
}

std::string LightsTable(const LightsReport& report) {
  std::string text = absl::StrFormat("%-10s %8s %11s %14s %8s %8s %9s\n", "kind", "lights",
                                     "prepare/ms", "us/receiver", "rays", "rr", "bias");
  for (const LightsCase& c : report.cases) {
    text +=
        absl::StrFormat("%-10s %8d %11.1f %14.2f %8.1f %8.4f %9.5f\n", c.kind, c.lights,
                        c.prepare_s * 1e3, c.us_per_receiver, c.rays_per_receiver, c.rr, c.bias);
  }
  return text;
}

}  // namespace farpoint
