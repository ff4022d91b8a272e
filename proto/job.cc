#include "proto/job.h"

#include <algorithm>
#include <cmath>
#include <cstdio>

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
  for (const SunOverride& sun : job.overrides.suns) {
    if (!IsFinite(sun.to_sun) || MaxAbs(sun.to_sun) == 0) {
      return Bad("overrides.suns.to_sun", Text(sun.to_sun), "a finite vector that is not zero");
    }
    FP_RETURN_IF_ERROR(CheckColor(sun.irradiance, "overrides.suns.irradiance", 1e30f));
  }
  if (job.overrides.sky) FP_RETURN_IF_ERROR(CheckColor(*job.overrides.sky, "overrides.sky", 1e30f));
  if (job.overrides.albedo) {
    FP_RETURN_IF_ERROR(CheckColor(*job.overrides.albedo, "overrides.albedo", 1));
  }
  if (job.title.size() > kMaxTitleBytes) {
    return Bad("title", std::to_string(job.title.size()) + " bytes long", "at most 200 bytes");
  }
  if (job.priority < -1000 || job.priority > 1000) {
    return Bad("priority", std::to_string(job.priority), "-1000 to 1000");
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

void ApplyOverrides(const SceneOverrides& overrides, Scene& scene) {
  if (!overrides.suns.empty()) {
    scene.lights.clear();
    for (const SunOverride& sun : overrides.suns) {
      PunctualLight light;
      light.name = "sun " + std::to_string(scene.lights.size());
      light.kind = PunctualKind::kDirectional;
      light.direction = -NormalizeOr(sun.to_sun, Vec3d(0, 1, 0));
      light.intensity = sun.irradiance;
      scene.lights.push_back(std::move(light));
    }
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
    for (Material& material : scene.materials) {
      material.base_color = *overrides.albedo;
      // A mask needs its texture's alpha: only then the texture stays, and its colour with it.
      if (material.alpha_mode != AlphaMode::kMask) material.base_color_texture = {};
    }
  }
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
