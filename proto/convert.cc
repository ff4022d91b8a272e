#include "proto/convert.h"

#include <google/protobuf/descriptor.h>
#include <google/protobuf/util/json_util.h>

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <nlohmann/json.hpp>
#include <set>

namespace farpoint {

namespace {

constexpr size_t kMaxAssetFiles = 65536;
constexpr size_t kMaxUriBytes = 4096;
constexpr size_t kMaxNameBytes = 200;
constexpr size_t kMaxIdBytes = 64;
constexpr size_t kMaxSuns = 256;
constexpr size_t kMaxStatEntries = 256;
constexpr size_t kMaxStatNameBytes = 64;
constexpr size_t kMaxTiles = size_t{1} << 22;  // 65536² pixels in tiles of 32
constexpr size_t kMaxNotes = 10000;

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

absl::StatusOr<Rgb> ColorFromWire(const v1::Rgb& wire, float max, std::string_view field) {
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

// Levenshtein distance.
size_t EditDistance(std::string_view a, std::string_view b) {
  std::vector<size_t> row(b.size() + 1);
  for (size_t j = 0; j <= b.size(); ++j) row[j] = j;
  for (size_t i = 1; i <= a.size(); ++i) {
    size_t diagonal = row[0];
    row[0] = i;
    for (size_t j = 1; j <= b.size(); ++j) {
      const size_t above = row[j];
      row[j] = std::min({row[j] + 1, row[j - 1] + 1, diagonal + (a[i - 1] != b[j - 1])});
      diagonal = above;
    }
  }
  return row[b.size()];
}

void CollectFieldNames(const google::protobuf::Descriptor& message, std::set<std::string>& names) {
  for (int i = 0; i < message.field_count(); ++i) {
    const auto* field = message.field(i);
    names.insert(field->name());
    if (field->message_type() != nullptr) CollectFieldNames(*field->message_type(), names);
  }
}

// "; did you mean 'spp'?" if protobuf's message is about an unknown field, else empty.
std::string NearestField(std::string_view message) {
  constexpr std::string_view kUnknown = ": Cannot find field.";
  const size_t end = message.find(kUnknown);
  if (end == std::string_view::npos) return "";
  const size_t start = message.rfind(' ', end) + 1;  // npos + 1 == 0
  const std::string_view unknown = message.substr(start, end - start);
  std::set<std::string> names;
  CollectFieldNames(*v1::RenderJob::descriptor(), names);
  const auto nearest = std::min_element(names.begin(), names.end(), [&](auto& a, auto& b) {
    return EditDistance(a, unknown) < EditDistance(b, unknown);
  });
  return std::string("; did you mean '") + *nearest + "'?";
}

}  // namespace

// --- The job file ----------------------------------------------------------------------------

absl::StatusOr<v1::RenderJob> RenderJobFromJson(std::string_view text, std::string_view name) {
  v1::RenderJob job;
  const auto status = google::protobuf::util::JsonStringToMessage(
      google::protobuf::StringPiece(text.data(), text.size()), &job);
  if (status.ok()) return job;
  std::string message(status.message().data(), status.message().size());
  try {
    // protobuf names no line; this parser does.
    (void)nlohmann::json::parse(text.begin(), text.end());
  } catch (const nlohmann::json::exception& e) {
    return absl::InvalidArgumentError("'" + std::string(name) + "' is not a job file: " + e.what() +
                                      "; correct the file there");
  }
  std::replace(message.begin(), message.end(), '\n', ' ');
  return absl::InvalidArgumentError("'" + std::string(name) + "' is not a job file: " + message +
                                    NearestField(message));
}

std::string RenderJobToJson(const v1::RenderJob& job) {
  google::protobuf::util::JsonPrintOptions options;
  options.add_whitespace = true;
  options.preserve_proto_field_names = true;
  std::string text;
  // Fails only for messages that hold an Any of an unknown type; ours hold none.
  (void)google::protobuf::util::MessageToJsonString(job, &text, options);
  return text;
}

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

  if (static_cast<size_t>(wire.overrides().suns_size()) > kMaxSuns) {
    return Bad("overrides.suns", std::to_string(wire.overrides().suns_size()) + " suns",
               "at most " + std::to_string(kMaxSuns));
  }
  for (const v1::Sun& from : wire.overrides().suns()) {
    SunOverride sun;
    FP_ASSIGN_OR_RETURN(sun.to_sun, VecFromWire(from.to_sun(), "overrides.suns.to_sun"));
    if (MaxAbs(sun.to_sun) == 0) {
      return Bad("overrides.suns.to_sun", "(0, 0, 0)", "a vector that is not zero");
    }
    FP_ASSIGN_OR_RETURN(sun.irradiance,
                        ColorFromWire(from.irradiance(), 1e30f, "overrides.suns.irradiance"));
    job.overrides.suns.push_back(sun);
  }
  if (wire.overrides().has_sky()) {
    FP_ASSIGN_OR_RETURN(job.overrides.sky,
                        ColorFromWire(wire.overrides().sky(), 1e30f, "overrides.sky"));
  }
  if (wire.overrides().has_albedo()) {
    FP_ASSIGN_OR_RETURN(job.overrides.albedo,
                        ColorFromWire(wire.overrides().albedo(), 1, "overrides.albedo"));
  }

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
  for (const SunOverride& sun : job.overrides.suns) {
    v1::Sun* to = wire.mutable_overrides()->add_suns();
    VecToWire(sun.to_sun, to->mutable_to_sun());
    ColorToWire(sun.irradiance, to->mutable_irradiance());
  }
  if (job.overrides.sky) ColorToWire(*job.overrides.sky, wire.mutable_overrides()->mutable_sky());
  if (job.overrides.albedo) {
    ColorToWire(*job.overrides.albedo, wire.mutable_overrides()->mutable_albedo());
  }
  wire.set_light_units(job.light_units == LightUnits::kRaw ? v1::LIGHT_UNITS_RAW
                                                           : v1::LIGHT_UNITS_PHOTOMETRIC);
  wire.mutable_limits()->set_max_pixels(job.limits.max_pixels);
  wire.mutable_limits()->set_max_asset_bytes(job.limits.max_asset_bytes);
  wire.mutable_limits()->set_max_triangles(job.limits.max_triangles);
  wire.mutable_limits()->set_max_surfels(job.limits.max_surfels);
  wire.mutable_limits()->set_max_seconds(job.limits.max_seconds);
  wire.set_title(job.title);
  wire.set_priority(job.priority);
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
  if (wire.has_spp()) settings.spp = wire.spp();
  if (wire.has_paths()) settings.paths = wire.paths();
  if (wire.has_light_samples()) settings.light_samples = wire.light_samples();
  if (wire.has_points()) settings.points = wire.points();
  if (wire.has_microbuffer_px()) settings.microbuffer = wire.microbuffer_px();
  if (wire.has_clusters()) settings.clusters = wire.clusters();
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
  }
  wire.set_buffer_map(settings.buffer_map == BufferMap::kCosine ? v1::BUFFER_MAP_COSINE
                                                                : v1::BUFFER_MAP_OCTAHEDRAL);
  wire.set_splat(settings.splat == Splat::kOpaque ? v1::SPLAT_OPAQUE : v1::SPLAT_COVERAGE);
  wire.set_spp(settings.spp);
  wire.set_paths(settings.paths);
  wire.set_light_samples(settings.light_samples);
  wire.set_points(settings.points);
  wire.set_microbuffer_px(settings.microbuffer);
  wire.set_clusters(settings.clusters);
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
  return wire;
}

absl::StatusOr<JobEvent> JobEventFromWire(const v1::JobEvent& wire) {
  JobEvent event;
  event.sequence = wire.sequence();
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
    case v1::JobEvent::kProgress:
    case v1::JobEvent::EVENT_NOT_SET:
      break;
  }
  return event;
}
v1::JobEvent ToWire(const JobEvent& event) {
  v1::JobEvent wire;
  wire.set_sequence(event.sequence);
  *wire.mutable_status() = ToWire(event.status);
  if (const auto* state = std::get_if<JobState>(&event.body)) {
    wire.set_state_changed(StateToWire(*state));
  } else if (const auto* tile = std::get_if<TileCommitted>(&event.body)) {
    wire.mutable_tile_committed()->set_tile(tile->tile);
    wire.mutable_tile_committed()->set_sha256(ToWire(tile->sha256));
  } else if (const auto* note = std::get_if<std::string>(&event.body)) {
    wire.set_note(*note);
  } else {
    wire.set_progress(true);
  }
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
    info.tiles.push_back(tile);
  }
  FP_RETURN_IF_ERROR(MatrixFromWire(wire.camera().world_to_camera(), info.camera.world_to_camera,
                                    "camera.world_to_camera"));
  FP_RETURN_IF_ERROR(MatrixFromWire(wire.camera().world_to_ndc(), info.camera.world_to_ndc,
                                    "camera.world_to_ndc"));
  FP_ASSIGN_OR_RETURN(info.stats, StatsFromWire(wire.stats()));
  if (static_cast<size_t>(wire.notes_size()) > kMaxNotes) {
    return Bad("notes", std::to_string(wire.notes_size()), "at most " + std::to_string(kMaxNotes));
  }
  info.notes.assign(wire.notes().begin(), wire.notes().end());
  if (wire.has_blobs()) {
    FP_ASSIGN_OR_RETURN(info.blobs, SceneBlobsFromWire(wire.blobs()));
  }
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
  }
  for (float v : info.camera.world_to_camera) wire.mutable_camera()->add_world_to_camera(v);
  for (float v : info.camera.world_to_ndc) wire.mutable_camera()->add_world_to_ndc(v);
  *wire.mutable_stats() = ToWire(info.stats);
  for (const std::string& note : info.notes) wire.add_notes(note);
  if (!info.blobs.prepared_scene.empty()) *wire.mutable_blobs() = ToWire(info.blobs);
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

absl::Status CheckProtocolVersion(uint32_t version, std::string_view peer) {
  if (version == kProtocolVersion) return absl::OkStatus();
  return absl::FailedPreconditionError(
      "the " + std::string(peer) + " speaks protocol " + std::to_string(version) +
      ", this coordinator protocol " + std::to_string(kProtocolVersion) + "; update the " +
      (version < kProtocolVersion ? std::string(peer) : std::string("coordinator")));
}

}  // namespace farpoint
