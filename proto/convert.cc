#include "proto/convert.h"

#include <algorithm>
#include <cmath>
#include <cstdio>

namespace farpoint {

namespace {

constexpr size_t kMaxAssetFiles = 65536;
constexpr size_t kMaxUriBytes = 4096;
constexpr size_t kMaxNameBytes = 200;
constexpr size_t kMaxIdBytes = 64;
constexpr size_t kMaxSuns = 256;
constexpr size_t kMaxLights = 65536;
constexpr size_t kMaxMaterials = 65536;
constexpr size_t kMaxLines = 10000;  // of an explanation
constexpr double kMaxRadiance = 1e30;
constexpr size_t kMaxStatEntries = 256;
constexpr size_t kMaxStatNameBytes = 64;
constexpr size_t kMaxTiles = size_t{1} << 22;  // 65536² pixels in tiles of 32
constexpr size_t kMaxNotes = 10000;

void LimitsToWire(const JobLimits& limits, v1::JobLimits* wire) {
  wire->set_max_pixels(limits.max_pixels);
  wire->set_max_asset_bytes(limits.max_asset_bytes);
  wire->set_max_triangles(limits.max_triangles);
  wire->set_max_surfels(limits.max_surfels);
  wire->set_max_seconds(limits.max_seconds);
}
// What is absent stays at its default.
JobLimits LimitsFromWire(const v1::JobLimits& wire) {
  JobLimits limits;
  if (wire.has_max_pixels()) limits.max_pixels = wire.max_pixels();
  if (wire.has_max_asset_bytes()) limits.max_asset_bytes = wire.max_asset_bytes();
  if (wire.has_max_triangles()) limits.max_triangles = wire.max_triangles();
  if (wire.has_max_surfels()) limits.max_surfels = wire.max_surfels();
  if (wire.has_max_seconds()) limits.max_seconds = wire.max_seconds();
  return limits;
}

std::string Path(std::string_view field, std::string_view member) {
  return field.empty() ? std::string(member) : std::string(field) + "." + std::string(member);
}

absl::Status Bad(std::string_view field, const std::string& value, std::string_view allowed) {
  return absl::InvalidArgumentError(std::string(field) + " is " + value +
                                    "; allowed: " + std::string(allowed));
}

std::string Text(double v) {
  char buffer[32];
  std::snprintf(buffer, sizeof(buffer), "%g", v);
  return buffer;
}

absl::Status CheckRange(double v, double min, double max, std::string_view field) {
  if (v >= min && v <= max) return absl::OkStatus();  // refuses NaN
  return Bad(field, Text(v), Text(min) + " to " + Text(max));
}

absl::Status CheckLength(const std::string& text, size_t max, std::string_view field) {
  if (text.size() <= max) return absl::OkStatus();
  return Bad(field, std::to_string(text.size()) + " bytes long",
             "at most " + std::to_string(max) + " bytes");
}

absl::Status CheckId(const std::string& id, std::string_view field) {
  if (id.empty()) return Bad(field, "empty", "an id given by the coordinator");
  return CheckLength(id, kMaxIdBytes, field);
}

absl::StatusOr<Vec3d> VecFromWire(const v1::Vec3& wire, std::string_view field) {
  const Vec3d v(wire.x(), wire.y(), wire.z());
  if (IsFinite(v)) return v;
  return Bad(field, std::string("(") + Text(v.x) + ", " + Text(v.y) + ", " + Text(v.z) + ")",
             "finite numbers");
}
void VecToWire(const Vec3d& v, v1::Vec3* wire) {
  wire->set_x(v.x);
  wire->set_y(v.y);
  wire->set_z(v.z);
}

absl::StatusOr<Rgb> ColorFromWire(const v1::Rgb& wire, double max, std::string_view field) {
  const Rgb c(wire.r(), wire.g(), wire.b());
  for (int i = 0; i < 3; ++i) FP_RETURN_IF_ERROR(CheckRange(c[i], 0, max, field));
  return c;
}
void ColorToWire(const Rgb& c, v1::Rgb* wire) {
  wire->set_r(c.x);
  wire->set_g(c.y);
  wire->set_b(c.z);
}

absl::Status CheckFraction(double v, std::string_view field) { return CheckRange(v, 0, 1, field); }

absl::StatusOr<JobState> StateFromWire(v1::JobState wire, std::string_view field) {
  switch (wire) {
    case v1::JOB_STATE_QUEUED:
      return JobState::kQueued;
    case v1::JOB_STATE_BAKING:
      return JobState::kBaking;
    case v1::JOB_STATE_RENDERING:
      return JobState::kRendering;
    case v1::JOB_STATE_DONE:
      return JobState::kDone;
    case v1::JOB_STATE_FAILED:
      return JobState::kFailed;
    case v1::JOB_STATE_CANCELLED:
      return JobState::kCancelled;
    case v1::JOB_STATE_PAUSED:
      return JobState::kPaused;
    default:
      return Bad(field, std::to_string(wire), "a value of JobState");
  }
}
v1::JobState StateToWire(JobState state) {
  switch (state) {
    case JobState::kQueued:
      return v1::JOB_STATE_QUEUED;
    case JobState::kBaking:
      return v1::JOB_STATE_BAKING;
    case JobState::kRendering:
      return v1::JOB_STATE_RENDERING;
    case JobState::kDone:
      return v1::JOB_STATE_DONE;
    case JobState::kFailed:
      return v1::JOB_STATE_FAILED;
    case JobState::kCancelled:
      return v1::JOB_STATE_CANCELLED;
    case JobState::kPaused:
      return v1::JOB_STATE_PAUSED;
  }
  return v1::JOB_STATE_UNSPECIFIED;
}

// 16 finite numbers, or none for a matrix that is not known yet.
absl::Status MatrixFromWire(const google::protobuf::RepeatedField<float>& wire,
                            std::array<float, 16>& matrix, std::string_view field) {
  if (wire.empty()) return absl::OkStatus();
  if (wire.size() != 16) return Bad(field, std::to_string(wire.size()) + " numbers", "16 numbers");
  for (int i = 0; i < 16; ++i) {
    if (!std::isfinite(wire[i])) return Bad(field, Text(wire[i]), "finite numbers");
    matrix[i] = wire[i];
  }
  return absl::OkStatus();
}

absl::Status CheckCount(int count, size_t max, std::string_view field, std::string_view what) {
  if (static_cast<size_t>(count) <= max) return absl::OkStatus();
  return Bad(field, std::to_string(count) + " " + std::string(what),
             "at most " + std::to_string(max));
}

absl::Status CheckName(const std::string& name, std::string_view field) {
  if (name.empty()) return Bad(field, "empty", "a name");
  return CheckLength(name, kMaxUriBytes, field);
}

absl::StatusOr<Vec3d> DirectionFromWire(const v1::Vec3& wire, std::string_view field) {
  FP_ASSIGN_OR_RETURN(const Vec3d v, VecFromWire(wire, field));
  if (MaxAbs(v) > 0) return v;
  return Bad(field, "(0, 0, 0)", "a vector that is not zero");
}

absl::StatusOr<PunctualLight> LightFromWire(const v1::Light& wire, const std::string& field) {
  PunctualLight light;
  FP_RETURN_IF_ERROR(CheckLength(wire.name(), kMaxUriBytes, Path(field, "name")));
  light.name = wire.name();
  switch (wire.kind()) {
    case v1::LIGHT_KIND_POINT:
      light.kind = PunctualKind::kPoint;
      break;
    case v1::LIGHT_KIND_SPOT:
      light.kind = PunctualKind::kSpot;
      break;
    case v1::LIGHT_KIND_DIRECTIONAL:
      light.kind = PunctualKind::kDirectional;
      break;
    default:
      return Bad(Path(field, "kind"),
                 wire.kind() == 0 ? std::string("absent") : std::to_string(wire.kind()),
                 "LIGHT_KIND_POINT, LIGHT_KIND_SPOT or LIGHT_KIND_DIRECTIONAL");
  }
  FP_ASSIGN_OR_RETURN(light.position, VecFromWire(wire.position(), Path(field, "position")));
  if (light.kind != PunctualKind::kPoint) {
    FP_ASSIGN_OR_RETURN(const Vec3d direction,
                        DirectionFromWire(wire.direction(), Path(field, "direction")));
    light.direction = NormalizeOr(direction, Vec3d(0, -1, 0));
  }
  FP_ASSIGN_OR_RETURN(light.intensity,
                      ColorFromWire(wire.intensity(), kMaxRadiance, Path(field, "intensity")));
  FP_RETURN_IF_ERROR(CheckRange(wire.range_m(), 0, kMaxRadiance, Path(field, "range_m")));
  light.range_m = wire.range_m();
  if (wire.has_inner_cone_rad()) light.inner_cone_rad = wire.inner_cone_rad();
  if (wire.has_outer_cone_rad()) light.outer_cone_rad = wire.outer_cone_rad();
  FP_RETURN_IF_ERROR(CheckRange(light.outer_cone_rad, 0, 3.14159265358979323846 / 2,
                                Path(field, "outer_cone_rad")));
  if (!(light.inner_cone_rad >= 0) || !(light.inner_cone_rad < light.outer_cone_rad)) {
    return Bad(Path(field, "inner_cone_rad"), Text(light.inner_cone_rad),
               "at least 0 and less than outer_cone_rad, which is " + Text(light.outer_cone_rad));
  }
  return light;
}
void LightToWire(const PunctualLight& light, v1::Light* wire) {
  wire->set_name(light.name);
  wire->set_kind(light.kind == PunctualKind::kPoint  ? v1::LIGHT_KIND_POINT
                 : light.kind == PunctualKind::kSpot ? v1::LIGHT_KIND_SPOT
                                                     : v1::LIGHT_KIND_DIRECTIONAL);
  VecToWire(light.position, wire->mutable_position());
  VecToWire(light.direction, wire->mutable_direction());
  ColorToWire(light.intensity, wire->mutable_intensity());
  wire->set_range_m(light.range_m);
  wire->set_inner_cone_rad(light.inner_cone_rad);
  wire->set_outer_cone_rad(light.outer_cone_rad);
}

absl::Status OverridesFromWire(const v1::Overrides& wire, SceneOverrides& overrides) {
  FP_RETURN_IF_ERROR(CheckCount(wire.suns_size(), kMaxSuns, "overrides.suns", "suns"));
  for (const v1::Sun& from : wire.suns()) {
    SunOverride sun;
    FP_ASSIGN_OR_RETURN(sun.to_sun, DirectionFromWire(from.to_sun(), "overrides.suns.to_sun"));
    FP_ASSIGN_OR_RETURN(sun.irradiance, ColorFromWire(from.irradiance(), kMaxRadiance,
                                                      "overrides.suns.irradiance"));
    overrides.suns.push_back(sun);
  }
  FP_RETURN_IF_ERROR(CheckCount(wire.lights_size(), kMaxLights, "overrides.lights", "lights"));
  for (int i = 0; i < wire.lights_size(); ++i) {
    FP_ASSIGN_OR_RETURN(
        PunctualLight light,
        LightFromWire(wire.lights(i), "overrides.lights[" + std::to_string(i) + "]"));
    overrides.lights.push_back(std::move(light));
  }
  if (wire.has_sky()) {
    FP_ASSIGN_OR_RETURN(overrides.sky, ColorFromWire(wire.sky(), kMaxRadiance, "overrides.sky"));
  }
  if (wire.has_environment()) {
    const v1::Environment& from = wire.environment();
    EnvironmentOverride environment;
    FP_RETURN_IF_ERROR(CheckName(from.uri(), "overrides.environment.uri"));
    environment.uri = from.uri();
    if (from.has_scale()) {
      FP_ASSIGN_OR_RETURN(environment.scale,
                          ColorFromWire(from.scale(), kMaxRadiance, "overrides.environment.scale"));
    }
    FP_RETURN_IF_ERROR(
        CheckRange(from.rotation_deg(), -1e6, 1e6, "overrides.environment.rotation_deg"));
    environment.rotation_deg = from.rotation_deg();
    if (from.has_up()) {
      FP_ASSIGN_OR_RETURN(environment.up, DirectionFromWire(from.up(), "overrides.environment.up"));
    }
    overrides.environment = std::move(environment);
  }
  if (wire.has_albedo()) {
    FP_ASSIGN_OR_RETURN(overrides.albedo, ColorFromWire(wire.albedo(), 1, "overrides.albedo"));
  }
  FP_RETURN_IF_ERROR(
      CheckCount(wire.materials_size(), kMaxMaterials, "overrides.materials", "materials"));
  for (int i = 0; i < wire.materials_size(); ++i) {
    const v1::MaterialOverride& from = wire.materials(i);
    const std::string field = "overrides.materials[" + std::to_string(i) + "]";
    MaterialOverride material;
    FP_RETURN_IF_ERROR(CheckName(from.name(), Path(field, "name")));
    material.name = from.name();
    if (from.has_base_color()) {
      FP_ASSIGN_OR_RETURN(material.base_color,
                          ColorFromWire(from.base_color(), 1, Path(field, "base_color")));
    }
    if (from.has_emission()) {
      FP_ASSIGN_OR_RETURN(material.emission,
                          ColorFromWire(from.emission(), kMaxRadiance, Path(field, "emission")));
    }
    overrides.materials.push_back(std::move(material));
  }
  return absl::OkStatus();
}

v1::Overrides OverridesToWire(const SceneOverrides& overrides) {
  v1::Overrides wire;
  for (const SunOverride& sun : overrides.suns) {
    v1::Sun* to = wire.add_suns();
    VecToWire(sun.to_sun, to->mutable_to_sun());
    ColorToWire(sun.irradiance, to->mutable_irradiance());
  }
  for (const PunctualLight& light : overrides.lights) LightToWire(light, wire.add_lights());
  if (overrides.sky) ColorToWire(*overrides.sky, wire.mutable_sky());
  if (overrides.environment) {
    v1::Environment* to = wire.mutable_environment();
    to->set_uri(overrides.environment->uri);
    ColorToWire(overrides.environment->scale, to->mutable_scale());
    to->set_rotation_deg(overrides.environment->rotation_deg);
    VecToWire(overrides.environment->up, to->mutable_up());
  }
  if (overrides.albedo) ColorToWire(*overrides.albedo, wire.mutable_albedo());
  for (const MaterialOverride& material : overrides.materials) {
    v1::MaterialOverride* to = wire.add_materials();
    to->set_name(material.name);
    if (material.base_color) ColorToWire(*material.base_color, to->mutable_base_color());
    if (material.emission) ColorToWire(*material.emission, to->mutable_emission());
  }
  return wire;
}

absl::StatusOr<std::vector<JobId>> JobIdsFromWire(
    const google::protobuf::RepeatedPtrField<std::string>& wire, std::string_view field) {
  FP_RETURN_IF_ERROR(CheckCount(wire.size(), kMaxAfter, field, "jobs"));
  std::vector<JobId> ids;
  for (const std::string& id : wire) {
    FP_RETURN_IF_ERROR(CheckId(id, field));
    ids.push_back({id});
  }
  return ids;
}

absl::StatusOr<CameraMatrices> MatricesFromWire(const v1::CameraMatrices& wire,
                                                std::string_view field) {
  CameraMatrices matrices;
  FP_RETURN_IF_ERROR(MatrixFromWire(wire.world_to_camera(), matrices.world_to_camera,
                                    Path(field, "world_to_camera")));
  FP_RETURN_IF_ERROR(
      MatrixFromWire(wire.world_to_ndc(), matrices.world_to_ndc, Path(field, "world_to_ndc")));
  return matrices;
}

}  // namespace

// --- The job ---------------------------------------------------------------------------------

absl::StatusOr<JobSpec> JobFromWire(const v1::RenderJob& wire) {
  JobSpec job;
  if (static_cast<size_t>(wire.asset().files_size()) > kMaxAssetFiles) {
    return Bad("asset.files", std::to_string(wire.asset().files_size()) + " files",
               "at most " + std::to_string(kMaxAssetFiles));
  }
  FP_RETURN_IF_ERROR(CheckLength(wire.asset().root(), kMaxUriBytes, "asset.root"));
  job.asset_root = wire.asset().root();
  for (const v1::AssetFile& file : wire.asset().files()) {
    if (file.uri().empty()) return Bad("asset.files.uri", "empty", "the name of a file");
    FP_RETURN_IF_ERROR(CheckLength(file.uri(), kMaxUriBytes, "asset.files.uri"));
    FP_ASSIGN_OR_RETURN(const Digest digest,
                        DigestFromWire(file.sha256(), "asset.files['" + file.uri() + "'].sha256"));
    if (!job.asset_files.emplace(file.uri(), digest).second) {
      return Bad("asset.files.uri", std::string("'") + file.uri() + "' twice", "each file once");
    }
  }
  FP_ASSIGN_OR_RETURN(job.settings, SettingsFromWire(wire.settings(), "settings"));
  if (wire.has_film()) {
    FP_ASSIGN_OR_RETURN(job.film, FilmFromWire(wire.film(), "film"));
  }

  switch (wire.camera().choice_case()) {
    case v1::CameraChoice::CHOICE_NOT_SET:
      break;
    case v1::CameraChoice::kName:
      FP_RETURN_IF_ERROR(CheckLength(wire.camera().name(), kMaxUriBytes, "camera.name"));
      job.camera = CameraName{wire.camera().name()};
      break;
    case v1::CameraChoice::kLookAt: {
      const v1::LookAt& from = wire.camera().look_at();
      LookAt look;
      FP_ASSIGN_OR_RETURN(look.eye, VecFromWire(from.eye(), "camera.look_at.eye"));
      FP_ASSIGN_OR_RETURN(look.target, VecFromWire(from.target(), "camera.look_at.target"));
      if (from.has_up()) {
        FP_ASSIGN_OR_RETURN(look.up, VecFromWire(from.up(), "camera.look_at.up"));
      }
      if (from.has_yfov_deg()) look.yfov_deg = from.yfov_deg();
      if (!(look.yfov_deg > 0) || !(look.yfov_deg < 180)) {
        return Bad("camera.look_at.yfov_deg", Text(look.yfov_deg), "more than 0, less than 180");
      }
      job.camera = look;
      break;
    }
  }

  FP_RETURN_IF_ERROR(OverridesFromWire(wire.overrides(), job.overrides));

  switch (wire.light_units()) {
    case v1::LIGHT_UNITS_UNSPECIFIED:
    case v1::LIGHT_UNITS_PHOTOMETRIC:
      job.light_units = LightUnits::kPhotometric;
      break;
    case v1::LIGHT_UNITS_RAW:
      job.light_units = LightUnits::kRaw;
      break;
    default:
      return Bad("light_units", std::to_string(wire.light_units()), "a value of LightUnits");
  }

  const auto limit = [](bool given, uint64_t value, std::string_view field,
                        uint64_t& to) -> absl::Status {
    if (!given) return absl::OkStatus();
    if (value == 0) return Bad(field, "0", "a positive number, or leave it out");
    to = value;
    return absl::OkStatus();
  };
  const v1::JobLimits& l = wire.limits();
  FP_RETURN_IF_ERROR(
      limit(l.has_max_pixels(), l.max_pixels(), "limits.max_pixels", job.limits.max_pixels));
  FP_RETURN_IF_ERROR(limit(l.has_max_asset_bytes(), l.max_asset_bytes(), "limits.max_asset_bytes",
                           job.limits.max_asset_bytes));
  FP_RETURN_IF_ERROR(limit(l.has_max_triangles(), l.max_triangles(), "limits.max_triangles",
                           job.limits.max_triangles));
  FP_RETURN_IF_ERROR(
      limit(l.has_max_surfels(), l.max_surfels(), "limits.max_surfels", job.limits.max_surfels));
  FP_RETURN_IF_ERROR(
      limit(l.has_max_seconds(), l.max_seconds(), "limits.max_seconds", job.limits.max_seconds));

  FP_RETURN_IF_ERROR(CheckLength(wire.title(), kMaxNameBytes, "title"));
  job.title = wire.title();
  FP_RETURN_IF_ERROR(CheckRange(wire.priority(), -1000, 1000, "priority"));
  job.priority = wire.priority();
  FP_RETURN_IF_ERROR(CheckCount(wire.frames_size(), kMaxFrames, "frames", "frames"));
  job.frames.assign(wire.frames().begin(), wire.frames().end());
  if (wire.has_fps()) job.fps = wire.fps();
  if (!(job.fps > 0) || !(job.fps <= 1000)) {
    return Bad("fps", Text(job.fps), "more than 0, at most 1000");
  }
  FP_ASSIGN_OR_RETURN(job.after, JobIdsFromWire(wire.after(), "after"));
  job.start_paused = wire.start_paused();
  return job;
}

v1::RenderJob ToWire(const JobSpec& job) {
  v1::RenderJob wire;
  wire.mutable_asset()->set_root(job.asset_root);
  for (const auto& [uri, digest] : job.asset_files) {
    v1::AssetFile* file = wire.mutable_asset()->add_files();
    file->set_uri(uri);
    file->set_sha256(digest.Hex());
  }
  *wire.mutable_settings() = ToWire(job.settings);
  if (job.film.width != 0) *wire.mutable_film() = ToWire(job.film);
  if (const auto* name = std::get_if<CameraName>(&job.camera)) {
    wire.mutable_camera()->set_name(name->name);
  } else if (const auto* look = std::get_if<LookAt>(&job.camera)) {
    v1::LookAt* to = wire.mutable_camera()->mutable_look_at();
    VecToWire(look->eye, to->mutable_eye());
    VecToWire(look->target, to->mutable_target());
    VecToWire(look->up, to->mutable_up());
    to->set_yfov_deg(look->yfov_deg);
  }
  *wire.mutable_overrides() = OverridesToWire(job.overrides);
  wire.set_light_units(job.light_units == LightUnits::kRaw ? v1::LIGHT_UNITS_RAW
                                                           : v1::LIGHT_UNITS_PHOTOMETRIC);
  LimitsToWire(job.limits, wire.mutable_limits());
  wire.set_title(job.title);
  wire.set_priority(job.priority);
  for (const int32_t frame : job.frames) wire.add_frames(frame);
  wire.set_fps(job.fps);
  for (const JobId& id : job.after) wire.add_after(id.value);
  wire.set_start_paused(job.start_paused);
  return wire;
}

// --- Parts -----------------------------------------------------------------------------------

absl::StatusOr<RenderSettings> SettingsFromWire(const v1::RenderSettings& wire,
                                                std::string_view field) {
  RenderSettings settings;
  switch (wire.integrator()) {
    case v1::INTEGRATOR_UNSPECIFIED:
      break;
    case v1::INTEGRATOR_FPBGI:
      settings.integrator = Integrator::kFpbgi;
      break;
    case v1::INTEGRATOR_PBGI:
      settings.integrator = Integrator::kPbgi;
      break;
    case v1::INTEGRATOR_DPBGI:
      settings.integrator = Integrator::kDpbgi;
      break;
    case v1::INTEGRATOR_PT:
      settings.integrator = Integrator::kPt;
      break;
    case v1::INTEGRATOR_IRRCACHE:
      settings.integrator = Integrator::kIrrcache;
      break;
    default:
      return Bad(Path(field, "integrator"), std::to_string(wire.integrator()),
                 "a value of Integrator");
  }
  switch (wire.buffer_map()) {
    case v1::BUFFER_MAP_UNSPECIFIED:
      break;
    case v1::BUFFER_MAP_OCTAHEDRAL:
      settings.buffer_map = BufferMap::kOctahedral;
      break;
    case v1::BUFFER_MAP_COSINE:
      settings.buffer_map = BufferMap::kCosine;
      break;
    default:
      return Bad(Path(field, "buffer_map"), std::to_string(wire.buffer_map()),
                 "a value of BufferMap");
  }
  switch (wire.splat()) {
    case v1::SPLAT_UNSPECIFIED:
      break;
    case v1::SPLAT_COVERAGE:
      settings.splat = Splat::kCoverage;
      break;
    case v1::SPLAT_OPAQUE:
      settings.splat = Splat::kOpaque;
      break;
    default:
      return Bad(Path(field, "splat"), std::to_string(wire.splat()), "a value of Splat");
  }
  switch (wire.filter()) {
    case v1::PIXEL_FILTER_UNSPECIFIED:
      break;
    case v1::PIXEL_FILTER_BOX:
      settings.filter = PixelFilter::kBox;
      break;
    case v1::PIXEL_FILTER_TRIANGLE:
      settings.filter = PixelFilter::kTriangle;
      break;
    case v1::PIXEL_FILTER_GAUSSIAN:
      settings.filter = PixelFilter::kGaussian;
      break;
    case v1::PIXEL_FILTER_BLACKMAN_HARRIS:
      settings.filter = PixelFilter::kBlackmanHarris;
      break;
    default:
      return Bad(Path(field, "filter"), std::to_string(wire.filter()), "a value of PixelFilter");
  }
  switch (wire.fill()) {
    case v1::FILL_UNSPECIFIED:
      break;
    case v1::FILL_AUTO:
      settings.fill = Fill::kAuto;
      break;
    case v1::FILL_RAYS:
      settings.fill = Fill::kRays;
      break;
    case v1::FILL_CUT:
      settings.fill = Fill::kCut;
      break;
    default:
      return Bad(Path(field, "fill"), std::to_string(wire.fill()), "a value of Fill");
  }
  switch (wire.quality()) {
    case v1::QUALITY_UNSPECIFIED:
      break;
    case v1::QUALITY_DRAFT:
      settings.quality = Quality::kDraft;
      break;
    case v1::QUALITY_NORMAL:
      settings.quality = Quality::kNormal;
      break;
    case v1::QUALITY_FINE:
      settings.quality = Quality::kFine;
      break;
    default:
      return Bad(Path(field, "quality"), std::to_string(wire.quality()), "a value of Quality");
  }
  switch (wire.materials()) {
    case v1::MATERIALS_UNSPECIFIED:
      break;
    case v1::MATERIALS_LAMBERT:
      settings.materials = Materials::kLambert;
      break;
    case v1::MATERIALS_GLTF:
      settings.materials = Materials::kGltf;
      break;
    default:
      return Bad(Path(field, "materials"), std::to_string(wire.materials()),
                 "a value of Materials");
  }
  if (wire.has_filter_width_px()) settings.filter_width_px = wire.filter_width_px();
  if (wire.has_spp()) settings.spp = wire.spp();
  if (wire.has_paths()) settings.paths = wire.paths();
  if (wire.has_light_samples()) settings.light_samples = wire.light_samples();
  if (wire.has_bounces()) settings.bounces = wire.bounces();
  if (wire.has_points()) settings.points = wire.points();
  if (wire.has_microbuffer_px()) settings.microbuffer = wire.microbuffer_px();
  if (wire.has_clusters()) settings.clusters = wire.clusters();
  if (wire.has_cache_error()) settings.cache_error = wire.cache_error();
  if (wire.has_ao_distance_m()) settings.ao_distance_m = wire.ao_distance_m();
  if (wire.has_cache_samples()) settings.cache_samples = wire.cache_samples();
  if (wire.has_epsilon()) settings.epsilon = wire.epsilon();
  if (wire.has_normal_weight()) settings.normal_weight = wire.normal_weight();
  if (wire.has_kmeans_iterations()) settings.kmeans_iterations = wire.kmeans_iterations();
  if (wire.has_seed()) settings.seed = wire.seed();
  if (wire.has_tile_px()) settings.tile_px = wire.tile_px();
  if (wire.has_no_skip()) settings.no_skip = wire.no_skip();
  if (wire.layers_size() > 0) {
    if (wire.layers_size() > kLayerCount) {
      return Bad(Path(field, "layers"), std::to_string(wire.layers_size()) + " layers",
                 "each layer once");
    }
    settings.layers.clear();
    for (const std::string& name : wire.layers()) {
      const absl::StatusOr<Layer> layer = LayerFromName(name);
      if (!layer.ok()) return Annotate(layer.status(), Path(field, "layers"));
      settings.layers.push_back(*layer);
    }
  }
  FP_RETURN_IF_ERROR(Annotate(ValidateSettings(settings), field));
  return settings;
}

v1::RenderSettings ToWire(const RenderSettings& settings) {
  v1::RenderSettings wire;
  switch (settings.integrator) {
    case Integrator::kFpbgi:
      wire.set_integrator(v1::INTEGRATOR_FPBGI);
      break;
    case Integrator::kPbgi:
      wire.set_integrator(v1::INTEGRATOR_PBGI);
      break;
    case Integrator::kDpbgi:
      wire.set_integrator(v1::INTEGRATOR_DPBGI);
      break;
    case Integrator::kPt:
      wire.set_integrator(v1::INTEGRATOR_PT);
      break;
    case Integrator::kIrrcache:
      wire.set_integrator(v1::INTEGRATOR_IRRCACHE);
      break;
  }
  wire.set_buffer_map(settings.buffer_map == BufferMap::kCosine ? v1::BUFFER_MAP_COSINE
                                                                : v1::BUFFER_MAP_OCTAHEDRAL);
  wire.set_splat(settings.splat == Splat::kOpaque ? v1::SPLAT_OPAQUE : v1::SPLAT_COVERAGE);
  switch (settings.filter) {
    case PixelFilter::kBox:
      wire.set_filter(v1::PIXEL_FILTER_BOX);
      break;
    case PixelFilter::kTriangle:
      wire.set_filter(v1::PIXEL_FILTER_TRIANGLE);
      break;
    case PixelFilter::kGaussian:
      wire.set_filter(v1::PIXEL_FILTER_GAUSSIAN);
      break;
    case PixelFilter::kBlackmanHarris:
      wire.set_filter(v1::PIXEL_FILTER_BLACKMAN_HARRIS);
      break;
  }
  switch (settings.fill) {
    case Fill::kAuto:
      wire.set_fill(v1::FILL_AUTO);
      break;
    case Fill::kRays:
      wire.set_fill(v1::FILL_RAYS);
      break;
    case Fill::kCut:
      wire.set_fill(v1::FILL_CUT);
      break;
  }
  switch (settings.quality) {
    case Quality::kDraft:
      wire.set_quality(v1::QUALITY_DRAFT);
      break;
    case Quality::kNormal:
      wire.set_quality(v1::QUALITY_NORMAL);
      break;
    case Quality::kFine:
      wire.set_quality(v1::QUALITY_FINE);
      break;
  }
  switch (settings.materials) {
    case Materials::kLambert:
      wire.set_materials(v1::MATERIALS_LAMBERT);
      break;
    case Materials::kGltf:
      wire.set_materials(v1::MATERIALS_GLTF);
      break;
  }
  wire.set_filter_width_px(settings.filter_width_px);
  wire.set_spp(settings.spp);
  wire.set_paths(settings.paths);
  wire.set_light_samples(settings.light_samples);
  wire.set_bounces(settings.bounces);
  wire.set_points(settings.points);
  wire.set_microbuffer_px(settings.microbuffer);
  wire.set_clusters(settings.clusters);
  wire.set_cache_error(settings.cache_error);
  wire.set_ao_distance_m(settings.ao_distance_m);
  wire.set_cache_samples(settings.cache_samples);
  wire.set_epsilon(settings.epsilon);
  wire.set_normal_weight(settings.normal_weight);
  wire.set_kmeans_iterations(settings.kmeans_iterations);
  wire.set_seed(settings.seed);
  wire.set_tile_px(settings.tile_px);
  wire.set_no_skip(settings.no_skip);
  for (Layer layer : settings.layers) wire.add_layers(std::string(InfoOf(layer).name));
  return wire;
}

absl::StatusOr<PixelRect> RectFromWire(const v1::Rect& wire, std::string_view field) {
  const PixelRect rect{wire.x0(), wire.y0(), wire.x1(), wire.y1()};
  for (int v : {rect.x0, rect.y0, rect.x1, rect.y1}) {
    FP_RETURN_IF_ERROR(CheckRange(v, 0, 65536, field));
  }
  if (rect.empty()) return Bad(field, "empty", "x0 < x1 and y0 < y1");
  return rect;
}
v1::Rect ToWire(const PixelRect& rect) {
  v1::Rect wire;
  wire.set_x0(rect.x0);
  wire.set_y0(rect.y0);
  wire.set_x1(rect.x1);
  wire.set_y1(rect.y1);
  return wire;
}

absl::StatusOr<FilmSpec> FilmFromWire(const v1::Film& wire, std::string_view field) {
  FP_RETURN_IF_ERROR(CheckRange(wire.width_px(), 1, 65536, Path(field, "width_px")));
  FP_RETURN_IF_ERROR(CheckRange(wire.height_px(), 1, 65536, Path(field, "height_px")));
  FilmSpec film;
  film.width = static_cast<int>(wire.width_px());
  film.height = static_cast<int>(wire.height_px());
  film.crop = film.frame();
  if (wire.has_crop()) {
    FP_ASSIGN_OR_RETURN(film.crop, RectFromWire(wire.crop(), Path(field, "crop")));
  }
  FP_RETURN_IF_ERROR(Annotate(ValidateFilm(film), field));
  return film;
}
v1::Film ToWire(const FilmSpec& film) {
  v1::Film wire;
  wire.set_width_px(static_cast<uint32_t>(film.width));
  wire.set_height_px(static_cast<uint32_t>(film.height));
  if (!(film.crop == film.frame())) *wire.mutable_crop() = ToWire(film.crop);
  return wire;
}

absl::StatusOr<Camera> CameraFromWire(const v1::Camera& wire, std::string_view field) {
  Camera camera;
  FP_ASSIGN_OR_RETURN(camera.eye, VecFromWire(wire.eye(), Path(field, "eye")));
  FP_ASSIGN_OR_RETURN(camera.right, VecFromWire(wire.right(), Path(field, "right")));
  FP_ASSIGN_OR_RETURN(camera.up, VecFromWire(wire.up(), Path(field, "up")));
  FP_ASSIGN_OR_RETURN(camera.forward, VecFromWire(wire.forward(), Path(field, "forward")));
  const Vec3d axes[3] = {camera.right, camera.up, camera.forward};
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j <= i; ++j) {
      const double expected = i == j ? 1 : 0;
      if (!(std::abs(Dot(axes[i], axes[j]) - expected) <= 1e-6)) {
        return Bad(field, "not orthonormal", "right, up and forward of length 1 at right angles");
      }
    }
  }
  camera.yfov_rad = wire.yfov_rad();
  if (!(camera.yfov_rad > 0) || !(camera.yfov_rad < 3.14159265358979)) {
    return Bad(Path(field, "yfov_rad"), Text(camera.yfov_rad), "more than 0, less than pi");
  }
  FP_RETURN_IF_ERROR(CheckLength(wire.name(), kMaxUriBytes, Path(field, "name")));
  camera.name = wire.name();
  return camera;
}
v1::Camera ToWire(const Camera& camera) {
  v1::Camera wire;
  VecToWire(camera.eye, wire.mutable_eye());
  VecToWire(camera.right, wire.mutable_right());
  VecToWire(camera.up, wire.mutable_up());
  VecToWire(camera.forward, wire.mutable_forward());
  wire.set_yfov_rad(camera.yfov_rad);
  wire.set_name(camera.name);
  return wire;
}

absl::StatusOr<Digest> DigestFromWire(const std::string& hex, std::string_view field,
                                      bool allow_empty) {
  if (hex.empty() && allow_empty) return Digest{};
  const absl::StatusOr<Digest> digest = Digest::FromHex(hex);
  if (!digest.ok() || digest->empty()) {
    return Bad(field, std::string("'") + hex.substr(0, 80) + "'",
               "a SHA-256 as 64 hexadecimal digits");
  }
  return *digest;
}
std::string ToWire(const Digest& digest) { return digest.empty() ? "" : digest.Hex(); }

absl::StatusOr<Stats> StatsFromWire(const v1::Stats& wire) {
  Stats stats;
  const auto read_seconds = [](const auto& from, std::string_view field, auto& to) -> absl::Status {
    for (const auto& [name, value] : from) {
      const auto at = std::find(kStageNames.begin(), kStageNames.end(), name);
      if (at == kStageNames.end()) {
        return Bad(field, "of stage '" + name.substr(0, kMaxStatNameBytes) + "'", "known stages");
      }
      FP_RETURN_IF_ERROR(CheckRange(value, 0, 1e12, Path(field, name)));
      to[at - kStageNames.begin()] = value;
    }
    return absl::OkStatus();
  };
  FP_RETURN_IF_ERROR(read_seconds(wire.seconds(), "stats.seconds", stats.seconds));
  FP_RETURN_IF_ERROR(read_seconds(wire.wall_seconds(), "stats.wall_seconds", stats.wall_seconds));
  const auto read_counts = [](const auto& from, std::string_view field, auto& to) -> absl::Status {
    if (from.size() > kMaxStatEntries) {
      return Bad(field, std::to_string(from.size()) + " entries",
                 "at most " + std::to_string(kMaxStatEntries));
    }
    for (const auto& [name, value] : from) {
      FP_RETURN_IF_ERROR(CheckLength(name, kMaxStatNameBytes, field));
      to[name] = value;
    }
    return absl::OkStatus();
  };
  FP_RETURN_IF_ERROR(read_counts(wire.counts(), "stats.counts", stats.counts));
  FP_RETURN_IF_ERROR(read_counts(wire.skipped(), "stats.skipped", stats.skipped));
  FP_RETURN_IF_ERROR(read_counts(wire.bytes(), "stats.bytes", stats.bytes));
  return stats;
}
v1::Stats ToWire(const Stats& stats) {
  v1::Stats wire;
  for (int i = 0; i < kStageCount; ++i) {
    if (stats.seconds[i] != 0) (*wire.mutable_seconds())[kStageNames[i]] = stats.seconds[i];
    if (stats.wall_seconds[i] != 0) {
      (*wire.mutable_wall_seconds())[kStageNames[i]] = stats.wall_seconds[i];
    }
  }
  for (const auto& [name, value] : stats.counts) (*wire.mutable_counts())[name] = value;
  for (const auto& [name, value] : stats.skipped) (*wire.mutable_skipped())[name] = value;
  for (const auto& [name, value] : stats.bytes) (*wire.mutable_bytes())[name] = value;
  return wire;
}

absl::StatusOr<SceneBlobs> SceneBlobsFromWire(const v1::SceneBlobs& wire) {
  SceneBlobs blobs;
  FP_ASSIGN_OR_RETURN(blobs.prepared_scene,
                      DigestFromWire(wire.prepared_scene(), "blobs.prepared_scene"));
  FP_ASSIGN_OR_RETURN(blobs.tree_topology,
                      DigestFromWire(wire.tree_topology(), "blobs.tree_topology", true));
  FP_ASSIGN_OR_RETURN(blobs.tree_radiance,
                      DigestFromWire(wire.tree_radiance(), "blobs.tree_radiance", true));
  return blobs;
}
v1::SceneBlobs ToWire(const SceneBlobs& blobs) {
  v1::SceneBlobs wire;
  wire.set_prepared_scene(ToWire(blobs.prepared_scene));
  wire.set_tree_topology(ToWire(blobs.tree_topology));
  wire.set_tree_radiance(ToWire(blobs.tree_radiance));
  return wire;
}

// --- Messages --------------------------------------------------------------------------------

absl::StatusOr<JobStatus> JobStatusFromWire(const v1::JobStatus& wire) {
  JobStatus status;
  FP_RETURN_IF_ERROR(CheckId(wire.id(), "status.id"));
  status.id.value = wire.id();
  status.title = wire.title();
  FP_ASSIGN_OR_RETURN(status.state, StateFromWire(wire.state(), "status.state"));
  const v1::TileCounts& t = wire.tiles();
  status.tiles = {t.queued(), t.leased(), t.committed(), t.failed(), t.total()};
  status.reissued = wire.reissued();
  status.refused_results = wire.refused_results();
  if (wire.has_eta_s()) {
    FP_RETURN_IF_ERROR(CheckRange(wire.eta_s(), 0, 1e12, "status.eta_s"));
    status.eta_s = wire.eta_s();
  }
  FP_RETURN_IF_ERROR(CheckRange(wire.error_code(), 0, 16, "status.error_code"));
  status.error = absl::Status(static_cast<absl::StatusCode>(wire.error_code()), wire.error());
  status.priority = wire.priority();
  FP_RETURN_IF_ERROR(CheckFraction(wire.progress(), "status.progress"));
  status.progress = wire.progress();
  status.submitted_unix_ms = wire.submitted_unix_ms();
  const v1::FrameCounts& frames = wire.frames();
  status.frames = {frames.total(), frames.baked(), frames.done()};
  FP_ASSIGN_OR_RETURN(status.after, JobIdsFromWire(wire.after(), "status.after"));
  status.owner = wire.owner();
  status.suspect_tiles = wire.suspect_tiles();
  return status;
}
v1::JobStatus ToWire(const JobStatus& status) {
  v1::JobStatus wire;
  wire.set_id(status.id.value);
  wire.set_title(status.title);
  wire.set_state(StateToWire(status.state));
  v1::TileCounts* t = wire.mutable_tiles();
  t->set_queued(status.tiles.queued);
  t->set_leased(status.tiles.leased);
  t->set_committed(status.tiles.committed);
  t->set_failed(status.tiles.failed);
  t->set_total(status.tiles.total);
  wire.set_reissued(status.reissued);
  wire.set_refused_results(status.refused_results);
  if (status.eta_s) wire.set_eta_s(*status.eta_s);
  wire.set_error_code(static_cast<int>(status.error.code()));
  wire.set_error(std::string(status.error.message()));
  wire.set_priority(status.priority);
  wire.set_progress(status.progress);
  wire.set_submitted_unix_ms(status.submitted_unix_ms);
  wire.mutable_frames()->set_total(status.frames.total);
  wire.mutable_frames()->set_baked(status.frames.baked);
  wire.mutable_frames()->set_done(status.frames.done);
  for (const JobId& id : status.after) wire.add_after(id.value);
  wire.set_owner(status.owner);
  wire.set_suspect_tiles(status.suspect_tiles);
  return wire;
}

absl::StatusOr<WorkerStatus> WorkerStatusFromWire(const v1::WorkerStatus& wire) {
  WorkerStatus status;
  FP_RETURN_IF_ERROR(CheckId(wire.id(), "worker.id"));
  status.id.value = wire.id();
  status.name = wire.name();
  status.version = wire.version();
  status.threads = wire.threads();
  FP_ASSIGN_OR_RETURN(status.fingerprint, DigestFromWire(wire.fingerprint(), "worker.fingerprint"));
  status.leases = wire.leases();
  status.committed = wire.committed();
  status.failures = wire.failures();
  status.set_aside = wire.set_aside();
  FP_RETURN_IF_ERROR(CheckRange(wire.idle_s(), 0, 1e12, "worker.idle_s"));
  status.idle_s = wire.idle_s();
  status.gone = wire.gone();
  return status;
}
v1::WorkerStatus ToWire(const WorkerStatus& status) {
  v1::WorkerStatus wire;
  wire.set_id(status.id.value);
  wire.set_name(status.name);
  wire.set_version(status.version);
  wire.set_threads(status.threads);
  wire.set_fingerprint(ToWire(status.fingerprint));
  wire.set_leases(status.leases);
  wire.set_committed(status.committed);
  wire.set_failures(status.failures);
  wire.set_set_aside(status.set_aside);
  wire.set_idle_s(status.idle_s);
  wire.set_gone(status.gone);
  return wire;
}

absl::StatusOr<JobEvent> JobEventFromWire(const v1::JobEvent& wire) {
  JobEvent event;
  event.sequence = wire.sequence();
  event.unix_ms = wire.unix_ms();
  FP_ASSIGN_OR_RETURN(event.status, JobStatusFromWire(wire.status()));
  switch (wire.event_case()) {
    case v1::JobEvent::kStateChanged: {
      FP_ASSIGN_OR_RETURN(event.body, StateFromWire(wire.state_changed(), "event.state_changed"));
      break;
    }
    case v1::JobEvent::kTileCommitted: {
      TileCommitted tile;
      tile.tile = wire.tile_committed().tile();
      FP_ASSIGN_OR_RETURN(tile.sha256, DigestFromWire(wire.tile_committed().sha256(),
                                                      "event.tile_committed.sha256"));
      event.body = tile;
      break;
    }
    case v1::JobEvent::kNote:
      event.body = wire.note();
      break;
    case v1::JobEvent::kLog: {
      FP_ASSIGN_OR_RETURN(event.body, LogLineFromWire(wire.log()));
      break;
    }
    case v1::JobEvent::kProgress:
    case v1::JobEvent::EVENT_NOT_SET:
      break;
  }
  return event;
}
v1::JobEvent ToWire(const JobEvent& event) {
  v1::JobEvent wire;
  wire.set_sequence(event.sequence);
  wire.set_unix_ms(event.unix_ms);
  *wire.mutable_status() = ToWire(event.status);
  if (const auto* state = std::get_if<JobState>(&event.body)) {
    wire.set_state_changed(StateToWire(*state));
  } else if (const auto* tile = std::get_if<TileCommitted>(&event.body)) {
    wire.mutable_tile_committed()->set_tile(tile->tile);
    wire.mutable_tile_committed()->set_sha256(ToWire(tile->sha256));
  } else if (const auto* note = std::get_if<std::string>(&event.body)) {
    wire.set_note(*note);
  } else if (const auto* line = std::get_if<LogLine>(&event.body)) {
    *wire.mutable_log() = ToWire(*line);
  } else {
    wire.set_progress(true);
  }
  return wire;
}

absl::StatusOr<LogLine> LogLineFromWire(const v1::LogLine& wire) {
  LogLine line;
  switch (wire.level()) {
    case v1::LOG_LEVEL_INFO:
      line.level = LogLevel::kInfo;
      break;
    case v1::LOG_LEVEL_WARNING:
      line.level = LogLevel::kWarning;
      break;
    case v1::LOG_LEVEL_ERROR:
      line.level = LogLevel::kError;
      break;
    default:
      return Bad("log.level", std::to_string(wire.level()), "a value of LogLevel");
  }
  line.text = wire.text();
  if (wire.has_tile()) line.tile = wire.tile();
  line.attempt = wire.attempt();
  line.worker = wire.worker();
  return line;
}

v1::LogLine ToWire(const LogLine& line) {
  v1::LogLine wire;
  switch (line.level) {
    case LogLevel::kInfo:
      wire.set_level(v1::LOG_LEVEL_INFO);
      break;
    case LogLevel::kWarning:
      wire.set_level(v1::LOG_LEVEL_WARNING);
      break;
    case LogLevel::kError:
      wire.set_level(v1::LOG_LEVEL_ERROR);
      break;
  }
  wire.set_text(line.text);
  if (line.tile) wire.set_tile(*line.tile);
  wire.set_attempt(line.attempt);
  wire.set_worker(line.worker);
  return wire;
}

absl::StatusOr<Explanation> ExplanationFromWire(const v1::ExplainResponse& wire) {
  FP_RETURN_IF_ERROR(CheckCount(wire.lines_size(), kMaxLines, "lines", "lines"));
  return Explanation{.lines = {wire.lines().begin(), wire.lines().end()}};
}
v1::ExplainResponse ToWire(const Explanation& explanation) {
  v1::ExplainResponse wire;
  for (const std::string& line : explanation.lines) wire.add_lines(line);
  return wire;
}

absl::StatusOr<JobInfo> JobInfoFromWire(const v1::FetchInfoResponse& wire) {
  JobInfo info;
  FP_ASSIGN_OR_RETURN(info.status, JobStatusFromWire(wire.status()));
  FP_ASSIGN_OR_RETURN(info.spec, JobFromWire(wire.job()));
  FP_RETURN_IF_ERROR(Annotate(ValidateJob(info.spec), "job"));
  if (static_cast<size_t>(wire.tiles_size()) > kMaxTiles) {
    return Bad("tiles", std::to_string(wire.tiles_size()), "at most " + std::to_string(kMaxTiles));
  }
  info.tiles.reserve(static_cast<size_t>(wire.tiles_size()));
  for (const v1::TileInfo& from : wire.tiles()) {
    TileInfo tile;
    FP_ASSIGN_OR_RETURN(tile.rect, RectFromWire(from.rect(), "tiles.rect"));
    if (!info.spec.film.crop.Contains(tile.rect)) {
      return Bad("tiles.rect", "outside the crop", "rectangles inside the job's crop");
    }
    FP_ASSIGN_OR_RETURN(tile.sha256, DigestFromWire(from.sha256(), "tiles.sha256", true));
    tile.frame = from.frame();
    if (tile.frame >= info.spec.frame_count()) {
      return Bad("tiles.frame", std::to_string(tile.frame),
                 "less than " + std::to_string(info.spec.frame_count()));
    }
    info.tiles.push_back(tile);
  }
  if (static_cast<size_t>(wire.frames_size()) != info.spec.frame_count()) {
    return Bad("frames", std::to_string(wire.frames_size()),
               "one for each of the job's " + std::to_string(info.spec.frame_count()));
  }
  info.frames.reserve(static_cast<size_t>(wire.frames_size()));
  for (const v1::FrameInfo& from : wire.frames()) {
    FrameInfo frame;
    frame.number = from.number();
    frame.baked = from.has_blobs();
    if (frame.baked) {
      FP_ASSIGN_OR_RETURN(frame.camera, MatricesFromWire(from.camera(), "frames.camera"));
      FP_ASSIGN_OR_RETURN(frame.blobs, SceneBlobsFromWire(from.blobs()));
    }
    info.frames.push_back(frame);
  }
  FP_ASSIGN_OR_RETURN(info.stats, StatsFromWire(wire.stats()));
  if (static_cast<size_t>(wire.notes_size()) > kMaxNotes) {
    return Bad("notes", std::to_string(wire.notes_size()), "at most " + std::to_string(kMaxNotes));
  }
  info.notes.assign(wire.notes().begin(), wire.notes().end());
  info.version = wire.version();
  return info;
}
v1::FetchInfoResponse ToWire(const JobInfo& info) {
  v1::FetchInfoResponse wire;
  *wire.mutable_status() = ToWire(info.status);
  *wire.mutable_job() = ToWire(info.spec);
  for (Layer layer : info.spec.settings.layers) wire.add_layers(std::string(InfoOf(layer).name));
  for (const TileInfo& tile : info.tiles) {
    v1::TileInfo* to = wire.add_tiles();
    *to->mutable_rect() = ToWire(tile.rect);
    to->set_sha256(ToWire(tile.sha256));
    to->set_frame(tile.frame);
  }
  for (const FrameInfo& frame : info.frames) {
    v1::FrameInfo* to = wire.add_frames();
    to->set_number(frame.number);
    if (!frame.baked) continue;
    for (float v : frame.camera.world_to_camera) to->mutable_camera()->add_world_to_camera(v);
    for (float v : frame.camera.world_to_ndc) to->mutable_camera()->add_world_to_ndc(v);
    *to->mutable_blobs() = ToWire(frame.blobs);
  }
  *wire.mutable_stats() = ToWire(info.stats);
  for (const std::string& note : info.notes) wire.add_notes(note);
  wire.set_version(info.version);
  return wire;
}

absl::StatusOr<WorkerHello> HelloFromWire(const v1::RegisterRequest& wire) {
  WorkerHello hello;
  FP_RETURN_IF_ERROR(CheckLength(wire.version(), kMaxNameBytes, "version"));
  hello.version = wire.version();
  FP_ASSIGN_OR_RETURN(hello.fingerprint, DigestFromWire(wire.fingerprint(), "fingerprint"));
  FP_RETURN_IF_ERROR(CheckRange(wire.threads(), 1, 65536, "threads"));
  hello.threads = wire.threads();
  FP_RETURN_IF_ERROR(CheckLength(wire.name(), kMaxNameBytes, "name"));
  hello.name = wire.name();
  return hello;
}
v1::RegisterRequest ToWire(const WorkerHello& hello) {
  v1::RegisterRequest wire;
  wire.set_protocol_version(kProtocolVersion);
  wire.set_oldest_protocol_version(kOldestProtocolVersion);
  wire.set_version(hello.version);
  wire.set_fingerprint(ToWire(hello.fingerprint));
  wire.set_threads(hello.threads);
  wire.set_name(hello.name);
  return wire;
}

absl::StatusOr<WorkerWelcome> WelcomeFromWire(const v1::RegisterResponse& wire) {
  WorkerWelcome welcome;
  FP_RETURN_IF_ERROR(CheckId(wire.worker_id(), "worker_id"));
  welcome.id.value = wire.worker_id();
  FP_RETURN_IF_ERROR(CheckRange(wire.heartbeat_ms(), 1, 600000, "heartbeat_ms"));
  welcome.heartbeat = std::chrono::milliseconds(wire.heartbeat_ms());
  FP_RETURN_IF_ERROR(CheckRange(wire.max_wait_ms(), 0, 600000, "max_wait_ms"));
  welcome.max_wait = std::chrono::milliseconds(wire.max_wait_ms());
  return welcome;
}
v1::RegisterResponse ToWire(const WorkerWelcome& welcome) {
  v1::RegisterResponse wire;
  wire.set_worker_id(welcome.id.value);
  wire.set_heartbeat_ms(static_cast<uint32_t>(welcome.heartbeat.count()));
  wire.set_max_wait_ms(static_cast<uint32_t>(welcome.max_wait.count()));
  return wire;
}

absl::StatusOr<TileWork> TileWorkFromWire(const v1::TileWork& wire) {
  TileWork work;
  FP_RETURN_IF_ERROR(CheckId(wire.lease_id(), "lease_id"));
  work.lease.value = wire.lease_id();
  FP_RETURN_IF_ERROR(CheckRange(wire.attempt(), 1, 1e6, "attempt"));
  work.attempt = wire.attempt();
  FP_RETURN_IF_ERROR(CheckId(wire.job_id(), "job_id"));
  work.job.value = wire.job_id();
  work.tile = wire.tile();
  FP_ASSIGN_OR_RETURN(work.rect, RectFromWire(wire.rect(), "rect"));
  FP_ASSIGN_OR_RETURN(work.frame.camera, CameraFromWire(wire.frame().camera(), "frame.camera"));
  FP_ASSIGN_OR_RETURN(work.frame.film, FilmFromWire(wire.frame().film(), "frame.film"));
  FP_ASSIGN_OR_RETURN(work.frame.settings,
                      SettingsFromWire(wire.frame().settings(), "frame.settings"));
  if (!work.frame.film.crop.Contains(work.rect)) {
    return Bad("rect", "outside the crop", "a rectangle inside frame.film.crop");
  }
  FP_ASSIGN_OR_RETURN(work.blobs, SceneBlobsFromWire(wire.blobs()));
  FP_RETURN_IF_ERROR(CheckRange(wire.lease_ms(), 1, 1e9, "lease_ms"));
  work.lease_time = std::chrono::milliseconds(wire.lease_ms());
  work.frame_index = wire.frame_index();
  work.careful = wire.careful();
  return work;
}
v1::TileWork ToWire(const TileWork& work) {
  v1::TileWork wire;
  wire.set_lease_id(work.lease.value);
  wire.set_attempt(work.attempt);
  wire.set_job_id(work.job.value);
  wire.set_tile(work.tile);
  *wire.mutable_rect() = ToWire(work.rect);
  *wire.mutable_frame()->mutable_camera() = ToWire(work.frame.camera);
  *wire.mutable_frame()->mutable_film() = ToWire(work.frame.film);
  *wire.mutable_frame()->mutable_settings() = ToWire(work.frame.settings);
  *wire.mutable_blobs() = ToWire(work.blobs);
  wire.set_lease_ms(static_cast<uint32_t>(work.lease_time.count()));
  wire.set_frame_index(work.frame_index);
  wire.set_careful(work.careful);
  return wire;
}

absl::StatusOr<ReturnHead> ReturnHeadFromWire(const v1::ReturnHeader& wire, uint64_t max_bytes) {
  ReturnHead head;
  FP_RETURN_IF_ERROR(CheckId(wire.worker_id(), "header.worker_id"));
  head.worker.value = wire.worker_id();
  FP_RETURN_IF_ERROR(CheckId(wire.lease_id(), "header.lease_id"));
  head.result.lease.value = wire.lease_id();
  head.result.attempt = wire.attempt();
  FP_ASSIGN_OR_RETURN(head.result.sha256, DigestFromWire(wire.sha256(), "header.sha256"));
  if (wire.size_bytes() == 0 || wire.size_bytes() > max_bytes) {
    return Bad("header.size_bytes", std::to_string(wire.size_bytes()),
               "1 to " + std::to_string(max_bytes));
  }
  head.size_bytes = wire.size_bytes();
  FP_ASSIGN_OR_RETURN(head.result.stats, StatsFromWire(wire.stats()));
  return head;
}
v1::ReturnHeader ToWire(const WorkerId& worker, const TileResult& result) {
  v1::ReturnHeader wire;
  wire.set_worker_id(worker.value);
  wire.set_lease_id(result.lease.value);
  wire.set_attempt(result.attempt);
  wire.set_sha256(ToWire(result.sha256));
  wire.set_size_bytes(result.bytes.size());
  *wire.mutable_stats() = ToWire(result.stats);
  return wire;
}

absl::StatusOr<CoordinatorHealth> HealthFromWire(const v1::DiagnoseResponse& wire) {
  CoordinatorHealth health;
  health.version = wire.version();
  health.protocol_version = wire.protocol_version();
  health.oldest_protocol_version = wire.oldest_protocol_version();
  health.unix_ms = wire.unix_ms();
  health.draining = wire.draining();
  health.caller_name = wire.caller_name();
  health.caller_role = wire.caller_role();
  health.store_error = wire.store_error();
  health.store_free_bytes = wire.store_free_bytes();
  health.store_total_bytes = wire.store_total_bytes();
  health.memory_available_bytes = wire.memory_available_bytes();
  health.memory_total_bytes = wire.memory_total_bytes();
  health.open_files = wire.open_files();
  health.open_files_limit = wire.open_files_limit();
  health.connections = wire.connections();
  health.max_connections = wire.max_connections();
  health.max_request_bytes = wire.max_request_bytes();
  health.max_blob_bytes = wire.max_blob_bytes();
  health.limits = LimitsFromWire(wire.limits());
  health.max_jobs = wire.max_jobs();
  health.max_bytes = wire.max_bytes();
  health.jobs = wire.jobs();
  health.bytes = wire.bytes();
  for (const v1::WorkerStatus& one : wire.workers()) {
    FP_ASSIGN_OR_RETURN(WorkerStatus worker, WorkerStatusFromWire(one));
    health.workers.push_back(std::move(worker));
  }
  health.blob_directory = wire.blob_dir();
  health.blob_mark = wire.blob_dir_mark();
  health.certificate_not_after_s = wire.certificate_not_after_unix_s();
  return health;
}
v1::DiagnoseResponse ToWire(const CoordinatorHealth& health) {
  v1::DiagnoseResponse wire;
  wire.set_version(health.version);
  wire.set_protocol_version(health.protocol_version);
  wire.set_oldest_protocol_version(health.oldest_protocol_version);
  wire.set_unix_ms(health.unix_ms);
  wire.set_draining(health.draining);
  wire.set_caller_name(health.caller_name);
  wire.set_caller_role(health.caller_role);
  wire.set_store_error(health.store_error);
  wire.set_store_free_bytes(health.store_free_bytes);
  wire.set_store_total_bytes(health.store_total_bytes);
  wire.set_memory_available_bytes(health.memory_available_bytes);
  wire.set_memory_total_bytes(health.memory_total_bytes);
  wire.set_open_files(health.open_files);
  wire.set_open_files_limit(health.open_files_limit);
  wire.set_connections(health.connections);
  wire.set_max_connections(health.max_connections);
  wire.set_max_request_bytes(health.max_request_bytes);
  wire.set_max_blob_bytes(health.max_blob_bytes);
  LimitsToWire(health.limits, wire.mutable_limits());
  wire.set_max_jobs(health.max_jobs);
  wire.set_max_bytes(health.max_bytes);
  wire.set_jobs(health.jobs);
  wire.set_bytes(health.bytes);
  for (const WorkerStatus& worker : health.workers) *wire.add_workers() = ToWire(worker);
  wire.set_blob_dir(health.blob_directory);
  wire.set_blob_dir_mark(health.blob_mark);
  wire.set_certificate_not_after_unix_s(health.certificate_not_after_s);
  return wire;
}

absl::StatusOr<uint32_t> AgreeOnProtocol(uint32_t oldest, uint32_t newest, std::string_view peer) {
  if (oldest == 0 || oldest > newest) oldest = newest;
  if (newest >= kOldestProtocolVersion && oldest <= kProtocolVersion) {
    return std::min(newest, kProtocolVersion);
  }
  const auto range = [](uint32_t from, uint32_t to) {
    return from == to ? std::to_string(to) : std::to_string(from) + " to " + std::to_string(to);
  };
  return absl::FailedPreconditionError(
      "the " + std::string(peer) + " speaks protocol " + range(oldest, newest) +
      ", this coordinator protocol " + range(kOldestProtocolVersion, kProtocolVersion) +
      "; update the " +
      (newest < kOldestProtocolVersion ? std::string(peer) : std::string("coordinator")));
}

absl::Status CheckFieldsKnown(const google::protobuf::Message& message, std::string_view where) {
  const google::protobuf::Reflection& reflection = *message.GetReflection();
  if (const auto& unknown = reflection.GetUnknownFields(message); !unknown.empty()) {
    return absl::FailedPreconditionError(std::string(where) + " has a field (number " +
                                         std::to_string(unknown.field(0).number()) +
                                         ") that this coordinator does not know; update the "
                                         "coordinator, or leave out what is new");
  }
  std::vector<const google::protobuf::FieldDescriptor*> fields;
  reflection.ListFields(message, &fields);
  for (const google::protobuf::FieldDescriptor* field : fields) {
    if (field->cpp_type() != google::protobuf::FieldDescriptor::CPPTYPE_MESSAGE) continue;
    const std::string path = std::string(where) + "." + field->name();
    if (!field->is_repeated()) {
      FP_RETURN_IF_ERROR(CheckFieldsKnown(reflection.GetMessage(message, field), path));
      continue;
    }
    for (int i = 0; i < reflection.FieldSize(message, field); ++i) {
      FP_RETURN_IF_ERROR(CheckFieldsKnown(reflection.GetRepeatedMessage(message, field, i),
                                          path + "[" + std::to_string(i) + "]"));
    }
  }
  return absl::OkStatus();
}

}  // namespace farpoint
