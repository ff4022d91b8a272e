#include "proto/job.h"

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <set>

#include "core/base/nearest_name.h"
#include "core/scene/environment_image.h"

namespace farpoint {

namespace {

constexpr double kDegree = 3.14159265358979323846 / 180;
constexpr size_t kMaxTitleBytes = 200;

absl::Status Bad(std::string_view field, const std::string& value, std::string_view allowed) {
  return absl::InvalidArgumentError(std::string(field) + " is " + value +
                                    "; allowed: " + std::string(allowed));
}

std::string Text(double v) {
  char buffer[32];
  std::snprintf(buffer, sizeof(buffer), "%g", v);
  return buffer;
}
std::string Text(const Vec3d& v) {
  return std::string("(") + Text(v.x) + ", " + Text(v.y) + ", " + Text(v.z) + ")";
}

absl::Status CheckColor(const Rgb& c, std::string_view field, float max) {
  for (int i = 0; i < 3; ++i) {
    if (!(c[i] >= 0) || !(c[i] <= max)) {
      return Bad(field, Text(Vec3d(c)), "numbers from 0 to " + Text(max));
    }
  }
  return absl::OkStatus();
}

absl::Status CheckOverrides(const JobSpec& job) {
  const SceneOverrides& overrides = job.overrides;
  for (const SunOverride& sun : overrides.suns) {
    if (!IsFinite(sun.to_sun) || MaxAbs(sun.to_sun) == 0) {
      return Bad("overrides.suns.to_sun", Text(sun.to_sun), "a finite vector that is not zero");
    }
    FP_RETURN_IF_ERROR(CheckColor(sun.irradiance, "overrides.suns.irradiance", 1e30f));
  }
  for (size_t i = 0; i < overrides.lights.size(); ++i) {
    const PunctualLight& light = overrides.lights[i];
    const std::string field = "overrides.lights[" + std::to_string(i) + "]";
    if (!IsFinite(light.position)) {
      return Bad(field + ".position", Text(light.position), "finite numbers");
    }
    if (light.kind != PunctualKind::kPoint &&
        (!IsFinite(light.direction) || std::abs(Length2(light.direction) - 1) > 1e-6)) {
      return Bad(field + ".direction", Text(light.direction), "a vector of length 1");
    }
    FP_RETURN_IF_ERROR(CheckColor(light.intensity, field + ".intensity", 1e30f));
    if (!(light.range_m >= 0) || !(light.range_m <= 1e30)) {
      return Bad(field + ".range_m", Text(light.range_m), "numbers from 0 to 1e+30");
    }
    if (!(light.inner_cone_rad >= 0) || !(light.inner_cone_rad < light.outer_cone_rad) ||
        !(light.outer_cone_rad <= 90 * kDegree)) {
      return Bad(field + ".inner_cone_rad and outer_cone_rad",
                 Text(light.inner_cone_rad) + " and " + Text(light.outer_cone_rad),
                 "0 <= inner < outer <= pi/2");
    }
  }
  if (overrides.sky) FP_RETURN_IF_ERROR(CheckColor(*overrides.sky, "overrides.sky", 1e30f));
  if (overrides.environment) {
    const EnvironmentOverride& environment = *overrides.environment;
    if (!job.asset_files.contains(environment.uri)) {
      return absl::InvalidArgumentError("overrides.environment.uri '" + environment.uri +
                                        "' is not among asset.files; add it with its sha256");
    }
    FP_RETURN_IF_ERROR(CheckColor(environment.scale, "overrides.environment.scale", 1e30f));
    if (!std::isfinite(environment.rotation_deg)) {
      return Bad("overrides.environment.rotation_deg", Text(environment.rotation_deg),
                 "a finite number");
    }
    if (!IsFinite(environment.up) || MaxAbs(environment.up) == 0) {
      return Bad("overrides.environment.up", Text(environment.up),
                 "a finite vector that is not zero");
    }
  }
  if (overrides.albedo) FP_RETURN_IF_ERROR(CheckColor(*overrides.albedo, "overrides.albedo", 1));
  for (size_t i = 0; i < overrides.materials.size(); ++i) {
    const MaterialOverride& material = overrides.materials[i];
    const std::string field = "overrides.materials[" + std::to_string(i) + "]";
    if (material.name.empty()) return Bad(field + ".name", "empty", "a material of the scene");
    if (material.base_color) {
      FP_RETURN_IF_ERROR(CheckColor(*material.base_color, field + ".base_color", 1));
    }
    if (material.emission) {
      FP_RETURN_IF_ERROR(CheckColor(*material.emission, field + ".emission", 1e30f));
    }
  }
  return absl::OkStatus();
}

absl::Status CheckSchedule(const JobSpec& job) {
  if (job.frames.size() > kMaxFrames) {
    return Bad("frames", std::to_string(job.frames.size()) + " frames",
               "at most " + std::to_string(kMaxFrames));
  }
  std::set<int32_t> frames;
  for (const int32_t frame : job.frames) {
    if (!frames.insert(frame).second) {
      return Bad("frames", std::to_string(frame) + " twice", "each frame once");
    }
  }
  if (!(job.fps > 0) || !(job.fps <= 1000)) {
    return Bad("fps", Text(job.fps), "more than 0, at most 1000");
  }
  if (job.after.size() > kMaxAfter) {
    return Bad("after", std::to_string(job.after.size()) + " jobs",
               "at most " + std::to_string(kMaxAfter));
  }
  if (job.priority < kMinPriority || job.priority > kMaxPriority) {
    return Bad("priority", std::to_string(job.priority), "-1000 to 1000");
  }
  return absl::OkStatus();
}

absl::Status CheckLookAt(const LookAt& look) {
  if (!IsFinite(look.eye)) return Bad("camera.look_at.eye", Text(look.eye), "finite numbers");
  if (!IsFinite(look.target)) {
    return Bad("camera.look_at.target", Text(look.target), "finite numbers");
  }
  if (!IsFinite(look.up) || MaxAbs(look.up) == 0) {
    return Bad("camera.look_at.up", Text(look.up), "a finite vector that is not zero");
  }
  if (look.eye == look.target) {
    return Bad("camera.look_at.target", Text(look.target), "a point other than the eye");
  }
  if (!(look.yfov_deg > 0) || !(look.yfov_deg < 180)) {
    return Bad("camera.look_at.yfov_deg", Text(look.yfov_deg), "more than 0 and less than 180");
  }
  const Vec3d zero;
  const Vec3d forward = NormalizeOr(look.target - look.eye, zero);
  const Vec3d right = Cross(forward, NormalizeOr(look.up, zero));
  if (!(Length2(right) > 1e-20)) {
    return Bad("camera.look_at.up", Text(look.up), "a vector that is not parallel to the view");
  }
  return absl::OkStatus();
}

}  // namespace

JobLimits Smaller(const JobLimits& a, const JobLimits& b) {
  return {.max_pixels = std::min(a.max_pixels, b.max_pixels),
          .max_asset_bytes = std::min(a.max_asset_bytes, b.max_asset_bytes),
          .max_triangles = std::min(a.max_triangles, b.max_triangles),
          .max_surfels = std::min(a.max_surfels, b.max_surfels),
          .max_seconds = std::min(a.max_seconds, b.max_seconds)};
}

absl::Status ValidateJob(const JobSpec& job) {
  FP_RETURN_IF_ERROR(Annotate(ValidateSettings(job.settings), "settings"));
  FP_RETURN_IF_ERROR(Annotate(ValidateFilm(job.film), "film"));
  if (job.asset_root.empty()) return absl::InvalidArgumentError("asset.root is empty; name a file");
  if (!job.asset_files.contains(job.asset_root)) {
    return absl::InvalidArgumentError("asset.root '" + job.asset_root +
                                      "' is not among asset.files; add it with its sha256");
  }
  if (const auto* look = std::get_if<LookAt>(&job.camera)) FP_RETURN_IF_ERROR(CheckLookAt(*look));
  FP_RETURN_IF_ERROR(CheckOverrides(job));
  FP_RETURN_IF_ERROR(CheckSchedule(job));
  if (job.title.size() > kMaxTitleBytes) {
    return Bad("title", std::to_string(job.title.size()) + " bytes long", "at most 200 bytes");
  }
  if (static_cast<uint64_t>(job.film.crop.area()) > job.limits.max_pixels) {
    return absl::ResourceExhaustedError(
        "film has " + std::to_string(job.film.crop.area()) + " pixels, the limit is " +
        std::to_string(job.limits.max_pixels) + "; render a smaller film or a crop");
  }
  if (job.settings.points > job.limits.max_surfels) {
    return absl::ResourceExhaustedError("settings.points is " +
                                        std::to_string(job.settings.points) + ", the limit is " +
                                        std::to_string(job.limits.max_surfels) + "; ask for fewer");
  }
  return absl::OkStatus();
}

absl::StatusOr<Camera> ResolveCamera(const CameraChoice& choice, const Scene& scene) {
  if (const auto* look = std::get_if<LookAt>(&choice)) {
    FP_RETURN_IF_ERROR(CheckLookAt(*look));
    const Vec3d zero;
    Camera camera;
    camera.name = "command line";
    camera.eye = look->eye;
    camera.forward = NormalizeOr(look->target - look->eye, zero);
    camera.right = Normalize(Cross(camera.forward, NormalizeOr(look->up, zero)));
    camera.up = Cross(camera.right, camera.forward);
    camera.yfov_rad = look->yfov_deg * kDegree;
    return camera;
  }
  if (const auto* name = std::get_if<CameraName>(&choice)) {
    std::string known;
    for (const Camera& camera : scene.cameras) {
      if (camera.name == name->name) return camera;
      if (!known.empty()) known += ", ";
      known.append("'").append(camera.name).append("'");
    }
    return absl::NotFoundError("camera '" + name->name + "' is not in the scene; it has " +
                               (known.empty() ? std::string("none") : known));
  }
  if (scene.cameras.empty()) {
    return absl::NotFoundError("the scene has no camera; give --eye, --target and --fov");
  }
  return scene.cameras.front();
}

namespace {

void ReplaceLights(const SceneOverrides& overrides, Scene& scene) {
  if (overrides.suns.empty() && overrides.lights.empty()) return;
  scene.lights.clear();
  for (const SunOverride& sun : overrides.suns) {
    PunctualLight light;
    light.name = "sun " + std::to_string(scene.lights.size());
    light.kind = PunctualKind::kDirectional;
    light.direction = -NormalizeOr(sun.to_sun, Vec3d(0, 1, 0));
    light.intensity = sun.irradiance;
    scene.lights.push_back(std::move(light));
  }
  scene.lights.insert(scene.lights.end(), overrides.lights.begin(), overrides.lights.end());
}

absl::Status ReplaceEnvironment(const EnvironmentOverride& from, const AssetBundle& asset,
                                Environment& environment) {
  const auto file = asset.files.find(from.uri);
  if (file == asset.files.end()) {
    return absl::NotFoundError("overrides.environment.uri '" + from.uri +
                               "' is not among the job's files; add it to asset.files");
  }
  environment = {};
  FP_RETURN_IF_ERROR(LoadEnvironmentMap(file->second, from.uri, environment));
  FP_RETURN_IF_ERROR(OrientEnvironmentMap(from.up, from.rotation_deg, environment));
  for (Rgb& texel : environment.map) texel = texel * from.scale;
  for (const Rgb& texel : environment.map) {
    if (IsFinite(texel)) continue;
    return absl::InvalidArgumentError("overrides.environment.scale makes '" + from.uri +
                                      "' larger than a number can be; choose a smaller scale");
  }
  return absl::OkStatus();
}

// A mask needs its texture's alpha: only then the texture stays, and its colour with it.
void SetBaseColor(const Rgb& color, Material& material) {
  material.base_color = color;
  if (material.alpha_mode != AlphaMode::kMask) material.base_color_texture = {};
}

// "'a', 'b'": the three names nearest to `name`.
std::string NearestMaterials(const std::string& name, const Scene& scene) {
  std::set<std::string> names;
  for (const Material& material : scene.materials) names.insert(material.name);
  std::vector<std::pair<int, std::string>> ranked;
  for (const std::string& known : names) ranked.emplace_back(EditDistance(name, known), known);
  std::sort(ranked.begin(), ranked.end());
  std::string text;
  for (size_t i = 0; i < std::min<size_t>(3, ranked.size()); ++i) {
    text += (i > 0 ? ", '" : "'") + ranked[i].second + "'";
  }
  return text;
}

}  // namespace

absl::Status ApplyOverrides(const SceneOverrides& overrides, const AssetBundle& asset,
                            Scene& scene) {
  ReplaceLights(overrides, scene);
  if (overrides.environment) {
    FP_RETURN_IF_ERROR(ReplaceEnvironment(*overrides.environment, asset, scene.environment));
  }
  if (overrides.sky) scene.environment.sky = *overrides.sky;
  if (overrides.albedo) {
    // Meshes without a material are white by the importer's rule: give them one that can be set.
    const int32_t fallback = static_cast<int32_t>(scene.materials.size());
    bool used = false;
    for (Mesh& mesh : scene.meshes) {
      if (mesh.material >= 0) continue;
      mesh.material = fallback;
      used = true;
    }
    if (used) scene.materials.emplace_back().name = "default";
    for (Material& material : scene.materials) SetBaseColor(*overrides.albedo, material);
  }
  for (const MaterialOverride& from : overrides.materials) {
    bool found = false;
    for (Material& material : scene.materials) {
      if (material.name != from.name) continue;
      found = true;
      if (from.base_color) SetBaseColor(*from.base_color, material);
      if (from.emission) {
        material.emission = *from.emission;
        material.emission_texture = {};
      }
    }
    if (found) continue;
    const std::string nearest = NearestMaterials(from.name, scene);
    return absl::NotFoundError(
        "overrides.materials: the scene has no material '" + from.name + "'; " +
        (nearest.empty() ? std::string("it has none") : "the nearest are " + nearest));
  }
  return absl::OkStatus();
}

std::string_view NameOf(JobState state) {
  switch (state) {
    case JobState::kQueued:
      return "queued";
    case JobState::kBaking:
      return "baking";
    case JobState::kRendering:
      return "rendering";
    case JobState::kDone:
      return "done";
    case JobState::kFailed:
      return "failed";
    case JobState::kCancelled:
      return "cancelled";
    case JobState::kPaused:
      return "paused";
  }
  return "unknown";
}

std::string_view NameOf(LogLevel level) {
  switch (level) {
    case LogLevel::kInfo:
      return "info";
    case LogLevel::kWarning:
      return "warning";
    case LogLevel::kError:
      return "error";
  }
  return "unknown";
}

CameraMatrices MatricesOf(const Camera& camera, const FilmSpec& film) {
  CameraMatrices m;
  // Camera space: x right, y up, looking along -z. Row vectors: rows are the images of the axes.
  const Vec3d axes[3] = {camera.right, camera.up, -camera.forward};
  double view[16] = {};
  for (int row = 0; row < 3; ++row) {
    for (int col = 0; col < 3; ++col) view[4 * row + col] = axes[col][row];
  }
  for (int col = 0; col < 3; ++col) view[12 + col] = -Dot(camera.eye, axes[col]);
  view[15] = 1;
  // NDC over the whole frame: x, y in [-1, 1], w = distance along the axis; no depth range, since
  // the camera clips nothing (z/w = 1 at infinity, 0 at 1 m before it).
  const double y_scale = 1 / std::tan(camera.yfov_rad / 2);
  const double x_scale = y_scale * film.height / film.width;
  double projection[16] = {};
  projection[0] = x_scale;
  projection[5] = y_scale;
  projection[10] = -1;
  projection[11] = -1;
  projection[14] = -1;
  for (int row = 0; row < 4; ++row) {
    for (int col = 0; col < 4; ++col) {
      double sum = 0;
      for (int k = 0; k < 4; ++k) sum += view[4 * row + k] * projection[4 * k + col];
      m.world_to_ndc[4 * row + col] = static_cast<float>(sum);
      m.world_to_camera[4 * row + col] = static_cast<float>(view[4 * row + col]);
    }
  }
  return m;
}

}  // namespace farpoint
