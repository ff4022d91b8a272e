#include "client/render_flags.h"

#include <algorithm>
#include <array>
#include <charconv>
#include <cmath>
#include <cstdint>
#include <limits>

#include "client/frame_range.h"
#include "core/base/nearest_name.h"
#include "core/image/layers.h"
#include "core/scene/scene_format.h"

namespace farpoint {
namespace {

using std::string_view_literals::operator""sv;

absl::Status Bad(std::string text) { return absl::InvalidArgumentError(text); }

std::vector<std::string_view> Split(std::string_view text, char separator) {
  std::vector<std::string_view> parts;
  while (true) {
    const size_t at = text.find(separator);
    parts.push_back(text.substr(0, at));
    if (at == std::string_view::npos) return parts;
    text.remove_prefix(at + 1);
  }
}

template <typename T>
bool ParseWhole(std::string_view text, T& value) {
  const char* end = text.data() + text.size();
  const auto result = std::from_chars(text.data(), end, value);
  return result.ec == std::errc() && result.ptr == end && !text.empty();
}

bool ParseFinite(std::string_view text, double& value) {
  return ParseWhole(text, value) && std::isfinite(value);
}

template <typename T>
absl::Status ParseCount(std::string_view text, T& value) {
  T parsed = 0;
  if (!ParseWhole(text, parsed)) {
    return Bad("expected a whole number from 0 to " +
               std::to_string(std::numeric_limits<T>::max()));
  }
  value = parsed;
  return absl::OkStatus();
}

absl::Status ParseVec3(std::string_view text, Vec3d& v) {
  const auto parts = Split(text, ',');
  Vec3d parsed;
  if (parts.size() != 3 || !ParseFinite(parts[0], parsed.x) || !ParseFinite(parts[1], parsed.y) ||
      !ParseFinite(parts[2], parsed.z)) {
    return Bad("expected three finite numbers with commas, e.g. 0,1.5,-2");
  }
  v = parsed;
  return absl::OkStatus();
}

absl::Status ParseColor(std::string_view text, double max, Rgb& color) {
  Vec3d v;
  FP_RETURN_IF_ERROR(ParseVec3(text, v));
  if (std::min({v.x, v.y, v.z}) < 0 || std::max({v.x, v.y, v.z}) > max) {
    return Bad(max == 1 ? "each component must lie in [0, 1]"
                        : "each component must lie in [0, 1e30]");
  }
  color = Rgb(v);
  return absl::OkStatus();
}

constexpr double kMaxRadiance = 1e30;  // as in ValidateJob

template <typename T>
struct Choice {
  std::string_view name;
  T value;
};

template <typename T, size_t N>
absl::Status ParseChoice(std::string_view text, const Choice<T> (&choices)[N], T& value) {
  std::vector<std::string> names;
  std::string listed;
  for (const auto& choice : choices) {
    if (text == choice.name) {
      value = choice.value;
      return absl::OkStatus();
    }
    names.emplace_back(choice.name);
    listed += (listed.empty() ? "" : ", ") + names.back();
  }
  const std::string nearest = NearestName(text, names);
  return Bad("expected one of " + listed +
             (nearest.empty() ? "" : "; did you mean '" + nearest + "'?"));
}

absl::Status ApplyIntegrator(std::string_view value, JobEdit& edit) {
  return ParseChoice(value,
                     {Choice<Integrator>{"fpbgi", Integrator::kFpbgi},
                      {"pbgi", Integrator::kPbgi},
                      {"dpbgi", Integrator::kDpbgi},
                      {"pt", Integrator::kPt},
                      {"irrcache", Integrator::kIrrcache}},
                     edit.spec.settings.integrator);
}

absl::Status ApplyResolution(std::string_view value, JobEdit& edit) {
  const auto parts = Split(value, 'x');
  int width = 0, height = 0;
  if (parts.size() != 2 || !ParseWhole(parts[0], width) || !ParseWhole(parts[1], height)) {
    return Bad("expected WIDTHxHEIGHT in pixels, e.g. 1280x720");
  }
  const FilmSpec film{width, height, {0, 0, width, height}};
  FP_RETURN_IF_ERROR(ValidateFilm(film));
  edit.spec.film = film;
  return absl::OkStatus();
}

absl::Status ApplyCrop(std::string_view value, JobEdit& edit) {
  const auto parts = Split(value, ',');
  PixelRect crop;
  if (parts.size() != 4 || !ParseWhole(parts[0], crop.x0) || !ParseWhole(parts[1], crop.y0) ||
      !ParseWhole(parts[2], crop.x1) || !ParseWhole(parts[3], crop.y1)) {
    return Bad("expected x0,y0,x1,y1 in pixels of the whole frame, x1 and y1 excluded");
  }
  FilmSpec film = edit.spec.film;
  film.crop = crop;
  FP_RETURN_IF_ERROR(ValidateFilm(film));
  edit.spec.film = film;
  return absl::OkStatus();
}

absl::Status ApplyClusters(std::string_view value, JobEdit& edit) {
  if (value == "adaptive") {
    edit.spec.settings.clusters = 0;
    return absl::OkStatus();
  }
  uint32_t clusters = 0;
  if (!ParseCount(value, clusters).ok() || clusters == 0) {
    return Bad("expected adaptive or the number of clusters per block, 1..1024");
  }
  edit.spec.settings.clusters = clusters;
  return absl::OkStatus();
}

absl::Status ApplyLayers(std::string_view value, JobEdit& edit) {
  std::vector<Layer> layers = DefaultLayers();
  for (std::string_view name : Split(value, ',')) {
    if (name == "none") {
      layers = {Layer::kBeauty};
      continue;
    }
    FP_ASSIGN_OR_RETURN(const Layer layer, LayerFromName(name));
    if (std::find(layers.begin(), layers.end(), layer) == layers.end()) layers.push_back(layer);
  }
  std::sort(layers.begin(), layers.end());  // the fixed order: equal sets are equal jobs
  edit.spec.settings.layers = std::move(layers);
  return absl::OkStatus();
}

absl::Status ApplySun(std::string_view value, JobEdit& edit) {
  const auto parts = Split(value, ':');
  if (parts.size() != 2) {
    return Bad("expected x,y,z:r,g,b: the direction to the sun and its irradiance in W/m²");
  }
  SunOverride sun;
  FP_RETURN_IF_ERROR(Annotate(ParseVec3(parts[0], sun.to_sun), "direction"));
  if (MaxAbs(sun.to_sun) == 0) return Bad("direction: must not be zero");
  FP_RETURN_IF_ERROR(Annotate(ParseColor(parts[1], kMaxRadiance, sun.irradiance), "irradiance"));
  if (!edit.suns_replaced) edit.spec.overrides.suns.clear();
  edit.suns_replaced = true;
  edit.spec.overrides.suns.push_back(sun);
  return absl::OkStatus();
}

absl::Status ParseDirection(std::string_view value, std::optional<Vec3d>& direction) {
  Vec3d v;
  FP_RETURN_IF_ERROR(ParseVec3(value, v));
  if (MaxAbs(v) == 0) return Bad("must not be zero");
  direction = v;
  return absl::OkStatus();
}

absl::Status ParsePoint(std::string_view value, std::optional<Vec3d>& point) {
  Vec3d v;
  FP_RETURN_IF_ERROR(ParseVec3(value, v));
  point = v;
  return absl::OkStatus();
}

absl::Status ApplyFov(std::string_view value, JobEdit& edit) {
  double fov_deg = 0;
  if (!ParseFinite(value, fov_deg) || fov_deg <= 0 || fov_deg >= 180) {
    return Bad("expected the vertical angle in degrees, more than 0 and less than 180");
  }
  edit.yfov_deg = fov_deg;
  return absl::OkStatus();
}

// --env-rotation and its like turn what --env or the job file names.
absl::Status EnvironmentOf(JobEdit& edit, EnvironmentOverride*& environment) {
  if (!edit.spec.overrides.environment) {
    return Bad("belongs to an environment map; give --env FILE.exr too");
  }
  environment = &*edit.spec.overrides.environment;
  return absl::OkStatus();
}

absl::Status ApplyEnvScale(std::string_view value, JobEdit& edit) {
  EnvironmentOverride* environment = nullptr;
  FP_RETURN_IF_ERROR(EnvironmentOf(edit, environment));
  double scale = 0;
  if (ParseFinite(value, scale)) {
    if (scale < 0 || scale > kMaxRadiance) return Bad("the number must lie in [0, 1e30]");
    environment->scale = Rgb(Vec3d(scale, scale, scale));
    return absl::OkStatus();
  }
  if (value.find(',') == std::string_view::npos) return Bad("expected one number or r,g,b");
  return ParseColor(value, kMaxRadiance, environment->scale);
}

absl::Status ApplyEnvRotation(std::string_view value, JobEdit& edit) {
  EnvironmentOverride* environment = nullptr;
  FP_RETURN_IF_ERROR(EnvironmentOf(edit, environment));
  double degrees = 0;
  if (!ParseFinite(value, degrees) || std::abs(degrees) > 1e6) {
    return Bad("expected an angle in degrees");
  }
  environment->rotation_deg = degrees;
  return absl::OkStatus();
}

absl::Status ApplyEnvUp(std::string_view value, JobEdit& edit) {
  EnvironmentOverride* environment = nullptr;
  FP_RETURN_IF_ERROR(EnvironmentOf(edit, environment));
  std::optional<Vec3d> up;
  FP_RETURN_IF_ERROR(ParseDirection(value, up));
  environment->up = *up;
  return absl::OkStatus();
}

absl::Status ApplyFilterWidth(std::string_view value, JobEdit& edit) {
  double width = 0;
  if (!ParseFinite(value, width) || std::abs(width) > std::numeric_limits<float>::max()) {
    return Bad("expected a number of pixels");
  }
  edit.spec.settings.filter_width_px = static_cast<float>(width);
  return absl::OkStatus();
}

absl::Status ApplyFps(std::string_view value, JobEdit& edit) {
  double fps = 0;
  if (!ParseFinite(value, fps) || fps <= 0 || fps > 1000) {
    return Bad("expected frames per second, more than 0 and at most 1000");
  }
  edit.spec.fps = fps;
  return absl::OkStatus();
}

// Makes one camera of what the flags say and what the job had.
absl::Status ResolveCameraFlags(JobEdit& edit) {
  const bool free = edit.eye || edit.target || edit.up || edit.yfov_deg;
  if (edit.camera_name) {
    if (free) {
      return Bad("--camera " + *edit.camera_name +
                 ": names a camera of the scene; leave --eye, --target, --up and --fov out");
    }
    edit.spec.camera = CameraName{*edit.camera_name};
    return absl::OkStatus();
  }
  if (!free) return absl::OkStatus();
  const LookAt* before = std::get_if<LookAt>(&edit.spec.camera);
  if (before == nullptr) {
    if (!edit.eye && !edit.target) {
      return Bad(std::string(edit.up ? "--up" : "--fov") +
                 ": belongs to a free camera; give --eye and --target too");
    }
    if (!edit.target) return Bad("--eye: needs --target; say what the camera looks at");
    if (!edit.eye) return Bad("--target: needs --eye; say where the camera stands");
  }
  LookAt look_at = before == nullptr ? LookAt{} : *before;
  look_at.eye = edit.eye.value_or(look_at.eye);
  look_at.target = edit.target.value_or(look_at.target);
  look_at.up = edit.up.value_or(look_at.up);
  look_at.yfov_deg = edit.yfov_deg.value_or(look_at.yfov_deg);
  const Vec3d forward = look_at.target - look_at.eye;
  if (MaxAbs(forward) == 0) return Bad("--eye, --target: are the same point; move one");
  if (MaxAbs(Cross(forward / MaxAbs(forward), look_at.up / MaxAbs(look_at.up))) < 1e-9) {
    return Bad("--up: is parallel to the line from --eye to --target; give another --up");
  }
  edit.spec.camera = look_at;
  return absl::OkStatus();
}

constexpr auto kImage = "Image"sv, kCamera = "Camera"sv, kLights = "Lights and materials"sv,
               kMethod = "Method"sv, kSpeed = "Speed only (no pixel changes)"sv;

constexpr RenderFlag kRenderFlags[] = {
    {"--preset", "NAME", kMethod,
     "paper: the paper's parameters (32x32 blocks, 100 clusters, epsilon 0.1, opaque splats, "
     "5 iterations, 64x64 buffers; docs/paper-map.md lists what differs all the same); other flags "
     "override it",
     [](std::string_view value, JobEdit& edit) {
       bool paper = false;
       FP_RETURN_IF_ERROR(ParseChoice(value, {Choice<bool>{"paper", true}}, paper));
       ApplyPaperPreset(edit.spec.settings);
       return absl::OkStatus();
     }},
    {"--integrator", "NAME", kMethod,
     "fpbgi (factorized point-based GI, the default), pbgi (every receiver alone), dpbgi (pbgi "
     "with a smaller buffer), pt (path tracing, the ground truth) or irrcache (an irradiance "
     "cache, "
     "to compare with: each worker makes that of the whole frame, whatever tiles it gets)",
     ApplyIntegrator},
    {"--resolution", "WxH", kImage, "size of the whole frame in pixels; default 1280x720",
     ApplyResolution},
    {"--crop", "x0,y0,x1,y1", kImage,
     "render only these pixels of the frame, x1 and y1 excluded; they equal those of the whole "
     "frame",
     ApplyCrop},
    {"--spp", "N", kImage, "receivers per pixel, 1..256; default 1: the pixel's centre",
     [](std::string_view value, JobEdit& edit) {
       return ParseCount(value, edit.spec.settings.spp);
     }},
    {"--filter", "NAME", kImage,
     "how the samples of a pixel are weighted: blackman-harris (the default), gaussian, triangle "
     "or "
     "box; of no effect at --spp 1",
     [](std::string_view value, JobEdit& edit) {
       FP_ASSIGN_OR_RETURN(edit.spec.settings.filter, PixelFilterFromName(value));
       return absl::OkStatus();
     }},
    {"--filter-width", "PX", kImage,
     "width of the filter's whole support in pixels, 0.01..16; default 0: the filter's own",
     ApplyFilterWidth},
    {"--frames", "RANGE", kImage,
     "frames of the scene's animation: numbers and ranges with commas, e.g. 1-10x2,15; give -o a "
     "place for the number, as in out.####.exr; default: one still of the rest pose",
     [](std::string_view value, JobEdit& edit) {
       FP_ASSIGN_OR_RETURN(edit.spec.frames, ParseFrameRange(value));
       return absl::OkStatus();
     }},
    {"--fps", "F", kImage, "frame f shows the scene at the time f / F seconds; default 24",
     ApplyFps},
    {"--aov", "LIST", kImage,
     "more layers besides the default ones, with commas: irradiance, direct_irradiance, …; 'none' "
     "in front leaves the default ones out, but for the image itself",
     ApplyLayers},
    {"--seed", "N", kImage, "seed of every random choice; default 0",
     [](std::string_view value, JobEdit& edit) {
       return ParseCount(value, edit.spec.settings.seed);
     }},
    {"--paths", "N", kMethod, "pt: paths per receiver, 1..1048576; default 64",
     [](std::string_view value, JobEdit& edit) {
       return ParseCount(value, edit.spec.settings.paths);
     }},
    {"--light-samples", "N", kMethod,
     "shadow rays per receiver, 1..4096; default 32: N for all emitters, N for the sky or map, one "
     "per point or spot light up to max(N, 8) of them, N drawn among more; up to 16 N where some "
     "rays to emitters or sky are blocked and others are not; a surfel takes a quarter of N on "
     "each side, up to N where emitters are blocked in part",
     [](std::string_view value, JobEdit& edit) {
       return ParseCount(value, edit.spec.settings.light_samples);
     }},
    {"--points", "N", kMethod, "surfels; default 0: from the scene's area and size",
     [](std::string_view value, JobEdit& edit) {
       return ParseCount(value, edit.spec.settings.points);
     }},
    {"--microbuffer", "N", kMethod,
     "side of the microbuffer in pixels, 1..256; default 0: the map's",
     [](std::string_view value, JobEdit& edit) {
       return ParseCount(value, edit.spec.settings.microbuffer);
     }},
    {"--buffer-map", "NAME", kMethod,
     "octahedral (whole sphere, the default) or cosine (hemisphere about the normal; pbgi, dpbgi)",
     [](std::string_view value, JobEdit& edit) {
       return ParseChoice(value,
                          {Choice<BufferMap>{"cosine", BufferMap::kCosine},
                           {"octahedral", BufferMap::kOctahedral}},
                          edit.spec.settings.buffer_map);
     }},
    {"--splat", "NAME", kMethod,
     "coverage (a node covers as much of a pixel as its solid angle, the default) or opaque (the "
     "nearest wins)",
     [](std::string_view value, JobEdit& edit) {
       return ParseChoice(value,
                          {Choice<Splat>{"coverage", Splat::kCoverage}, {"opaque", Splat::kOpaque}},
                          edit.spec.settings.splat);
     }},
    {"--clusters", "adaptive|N", kMethod,
     "fpbgi: adaptive (the default): clusters follow the scene, coarse to fine; N: so many per "
     "block "
     "of 32x32 pixels, 1..1024, as the paper",
     ApplyClusters},
    {"--fill", "HOW", kMethod,
     "fpbgi: what fills a cluster's buffer: rays, a cut of the point tree, or auto (the default: "
     "rays for adaptive clusters, cut for N)",
     [](std::string_view value, JobEdit& edit) {
       FP_ASSIGN_OR_RETURN(edit.spec.settings.fill, FillFromName(value));
       return absl::OkStatus();
     }},
    {"--quality", "LEVEL", kMethod,
     "fpbgi, adaptive clusters, and irrcache: the error to aim at: draft, normal (the default) or "
     "fine",
     [](std::string_view value, JobEdit& edit) {
       FP_ASSIGN_OR_RETURN(edit.spec.settings.quality, QualityFromName(value));
       return absl::OkStatus();
     }},
    {"--ao-distance", "METRES", kMethod,
     "of the layer ambient_occlusion: what lies at least so far away hides nothing; a number above "
     "0 or inf; default 0: a tenth of the scene's diagonal",
     [](std::string_view value, JobEdit& edit) {
       double metres = std::numeric_limits<double>::infinity();
       if (value != "inf" && (!ParseFinite(value, metres) || metres < 0 ||
                              metres > std::numeric_limits<float>::max() ||
                              (metres > 0 && !(static_cast<float>(metres) > 0)))) {
         return Bad("expected 0, a number of metres above 0, or inf");
       }
       edit.spec.settings.ao_distance_m = static_cast<float>(metres);
       return absl::OkStatus();
     }},
    {"--cache-error", "A", kMethod,
     "irrcache: a record's reach over the mean distance of what it sees, 0.01..10; default 0: by "
     "--quality",
     [](std::string_view value, JobEdit& edit) {
       double error = 0;
       if (!ParseFinite(value, error) || (error != 0 && (error < 0.01 || error > 10))) {
         return Bad("expected 0 or a number from 0.01 to 10");
       }
       edit.spec.settings.cache_error = static_cast<float>(error);
       return absl::OkStatus();
     }},
    {"--cache-samples", "N", kMethod,
     "irrcache: rays of a record, 4..1048576; default 0: by --quality",
     [](std::string_view value, JobEdit& edit) {
       return ParseCount(value, edit.spec.settings.cache_samples);
     }},
    {"--epsilon", "E", kMethod, "fpbgi: nodes are far where R_cluster < E (d - r); default 0.2",
     [](std::string_view value, JobEdit& edit) {
       double epsilon = 0;
       if (!ParseFinite(value, epsilon) || epsilon < 0 ||
           epsilon > std::numeric_limits<float>::max()) {
         return Bad("expected a finite number of at least 0");
       }
       edit.spec.settings.epsilon = static_cast<float>(epsilon);
       return absl::OkStatus();
     }},
    {"--bounces", "N", kMethod,
     "bounces of indirect light, 1..64; stops where one adds less than 0.1 %; default 1",
     [](std::string_view value, JobEdit& edit) {
       return ParseCount(value, edit.spec.settings.bounces);
     }},
    {"--materials", "M", kMethod,
     "lambert: base colours only (the default); gltf: metal, gloss and normal maps too",
     [](std::string_view value, JobEdit& edit) {
       FP_ASSIGN_OR_RETURN(edit.spec.settings.materials, MaterialsFromName(value));
       return absl::OkStatus();
     }},
    {"--camera", "NAME", kCamera, "a camera of the scene; default: the first",
     [](std::string_view value, JobEdit& edit) {
       if (value.empty()) return Bad("expected the name of a camera of the scene");
       edit.camera_name = std::string(value);
       return absl::OkStatus();
     }},
    {"--eye", "x,y,z", kCamera, "a free camera's position in metres; needs --target",
     [](std::string_view value, JobEdit& edit) { return ParsePoint(value, edit.eye); }},
    {"--target", "x,y,z", kCamera, "what the free camera looks at; needs --eye",
     [](std::string_view value, JobEdit& edit) { return ParsePoint(value, edit.target); }},
    {"--up", "x,y,z", kCamera, "the free camera's upward direction; default 0,1,0",
     [](std::string_view value, JobEdit& edit) { return ParseDirection(value, edit.up); }},
    {"--fov", "DEG", kCamera, "the free camera's vertical field of view in degrees; default 45",
     ApplyFov},
    {"--sun", "x,y,z:r,g,b", kLights,
     "a sun in place of the scene's punctual lights: the direction from the scene to it, its "
     "irradiance on a facing surface in W/m²; may be repeated",
     ApplySun, /*repeatable=*/true},
    {"--sky", "r,g,b", kLights,
     "a constant sky of this radiance in W/(m² sr); replaces the scene's",
     [](std::string_view value, JobEdit& edit) {
       Rgb sky;
       FP_RETURN_IF_ERROR(ParseColor(value, kMaxRadiance, sky));
       edit.spec.overrides.sky = sky;
       return absl::OkStatus();
     }},
    {"--env", "FILE", kLights,
     "an environment map, lat-long .exr or .hdr, in place of the scene's sky and map; --sky adds "
     "to it",
     [](std::string_view value, JobEdit& edit) {
       if (value.empty()) return Bad("expected a file");
       // Of a job file's map only the orientation and the scale stay.
       if (!edit.spec.overrides.environment) edit.spec.overrides.environment.emplace();
       edit.spec.overrides.environment->uri = std::string(value);
       return absl::OkStatus();
     }},
    {"--env-rotation", "DEG", kLights,
     "turns the map about its up, counter-clockwise seen from above; default 0", ApplyEnvRotation},
    {"--env-scale", "S", kLights, "scales the map's radiance: one number or r,g,b; default 1",
     ApplyEnvScale},
    {"--env-up", "x,y,z", kLights, "where the map's top points; default 0,1,0", ApplyEnvUp},
    {"--albedo", "r,g,b", kLights,
     "replaces every material's base colour and its texture, each in [0, 1]",
     [](std::string_view value, JobEdit& edit) {
       Rgb albedo;
       FP_RETURN_IF_ERROR(ParseColor(value, 1, albedo));
       edit.spec.overrides.albedo = albedo;
       return absl::OkStatus();
     }},
    {"--light-units", "UNITS", kLights,
     "photometric (glTF's lux and candela are divided by 683 lm/W, the default) or raw (taken as "
     "W/m² and W/sr)",
     [](std::string_view value, JobEdit& edit) {
       return ParseChoice(
           value,
           {Choice<LightUnits>{"photometric", LightUnits::kPhotometric}, {"raw", LightUnits::kRaw}},
           edit.spec.light_units);
     }},
    {"--tile", "N", kSpeed, "side of a tile in pixels, a multiple of 32; default 128",
     [](std::string_view value, JobEdit& edit) {
       return ParseCount(value, edit.spec.settings.tile_px);
     }},
    {"--no-skip", "", kMethod,
     "compute also what the scene does not need; cuts then hold nodes below the horizon, which "
     "changes them a little",
     [](std::string_view, JobEdit& edit) {
       edit.spec.settings.no_skip = true;
       return absl::OkStatus();
     }},
};

// What the settings in force make use of.
class Use {
 public:
  explicit Use(const RenderSettings& settings) : s_(settings) {}

  bool Is(Integrator integrator) const { return s_.integrator == integrator; }
  bool adaptive() const { return s_.adaptive(); }
  bool surfels() const { return s_.point_based(); }
  // Cuts of the tree, drawn into microbuffers.
  bool cuts() const {
    return surfels() && (!Is(Integrator::kFpbgi) || s_.fill_in_force() == Fill::kCut);
  }
  // Clusters whose buffers hold what is far only.
  bool far_and_near() const { return Is(Integrator::kFpbgi) && !adaptive() && cuts(); }
  bool quality() const {
    if (Is(Integrator::kIrrcache)) return s_.cache_error == 0.0f || s_.cache_samples == 0;
    return adaptive();
  }
  bool filter() const { return s_.spp > 1; }
  bool wants(Layer layer) const {
    return std::find(s_.layers.begin(), s_.layers.end(), layer) != s_.layers.end();
  }

  // The flags that decide the method.
  std::string method() const {
    std::string text = "--integrator ";
    text.append(NameOf(s_.integrator));
    if (Is(Integrator::kIrrcache) && !quality())
      return text + ", --cache-error and --cache-samples";
    if (!Is(Integrator::kFpbgi)) return text;
    text += adaptive() ? ", adaptive clusters" : ", --clusters " + std::to_string(s_.clusters);
    return text + (cuts() ? " filled by cuts" : " filled by rays");
  }

 private:
  const RenderSettings& s_;
};

// Flags that only some methods read. Those without a rule always count.
struct UseRule {
  std::string_view flag;
  bool (*counts)(const Use&);
  std::string_view where;  // "it counts …"
  bool of_method = true;   // else of --spp
};
constexpr auto kPointBased = "with --integrator fpbgi, pbgi or dpbgi"sv;
constexpr auto kDrawn = "with --integrator pbgi or dpbgi and with --fill cut"sv;
constexpr auto kCaches = "with --integrator irrcache"sv;
constexpr auto kFactorized = "with --integrator fpbgi"sv;
constexpr auto kManySamples = "from --spp 2 on"sv;
constexpr UseRule kUseRules[] = {
    {"--preset", [](const Use& u) { return u.surfels(); }, kPointBased},
    {"--filter", [](const Use& u) { return u.filter(); }, kManySamples, false},
    {"--filter-width", [](const Use& u) { return u.filter(); }, kManySamples, false},
    {"--paths", [](const Use& u) { return u.Is(Integrator::kPt); }, "with --integrator pt"},
    {"--points", [](const Use& u) { return u.surfels(); }, kPointBased},
    {"--microbuffer", [](const Use& u) { return u.cuts(); }, kDrawn},
    {"--buffer-map", [](const Use& u) { return u.cuts(); }, kDrawn},
    {"--splat", [](const Use& u) { return u.cuts(); }, kDrawn},
    {"--clusters", [](const Use& u) { return u.Is(Integrator::kFpbgi); }, kFactorized},
    {"--fill", [](const Use& u) { return u.Is(Integrator::kFpbgi); }, kFactorized},
    {"--quality", [](const Use& u) { return u.quality(); },
     "with --integrator fpbgi and adaptive clusters, and with irrcache where --cache-error or "
     "--cache-samples is left to it"},
    {"--cache-error", [](const Use& u) { return u.Is(Integrator::kIrrcache); }, kCaches},
    {"--cache-samples", [](const Use& u) { return u.Is(Integrator::kIrrcache); }, kCaches},
    {"--ao-distance", [](const Use& u) { return u.wants(Layer::kAmbientOcclusion); },
     "with --aov ambient_occlusion"},
    {"--epsilon", [](const Use& u) { return u.far_and_near(); },
     "with --integrator fpbgi, --clusters N and buffers filled by cuts"},
};

std::string Lower(std::string_view text) {
  std::string lower(text);
  for (char& c : lower) c = c >= 'A' && c <= 'Z' ? static_cast<char>(c - 'A' + 'a') : c;
  return lower;
}

}  // namespace

std::span<const RenderFlag> RenderFlags() { return kRenderFlags; }

absl::Status ApplyRenderFlags(std::span<const GivenFlag> given, JobSpec& spec) {
  JobEdit edit{.spec = spec};
  if (edit.spec.film.width == 0) {
    edit.spec.film = {kDefaultWidth, kDefaultHeight, {0, 0, kDefaultWidth, kDefaultHeight}};
  }
  // Ranges live in one place, ValidateSettings; the flag that made the settings wrong is the one to
  // blame. Only the end counts: a later flag may heal what an earlier one broke.
  absl::Status settings_status = ValidateSettings(edit.spec.settings);
  std::string blamed = "settings";
  for (const RenderFlag& flag : RenderFlags()) {
    for (const auto& [name, value] : given) {
      if (name != flag.name) continue;
      const std::string context = value.empty() ? name : name + " " + value;
      FP_RETURN_IF_ERROR(Annotate(flag.apply(value, edit), context));
      const bool was_valid = settings_status.ok();
      settings_status = ValidateSettings(edit.spec.settings);
      if (was_valid) blamed = context;
    }
  }
  FP_RETURN_IF_ERROR(Annotate(settings_status, blamed));
  FP_RETURN_IF_ERROR(ResolveCameraFlags(edit));
  spec = std::move(edit.spec);
  return absl::OkStatus();
}

std::vector<std::string> IneffectiveFlags(std::span<const GivenFlag> given,
                                          const RenderSettings& settings) {
  const Use use(settings);
  std::vector<std::string> lines;
  for (const RenderFlag& flag : RenderFlags()) {
    const bool is_given = std::any_of(given.begin(), given.end(),
                                      [&](const GivenFlag& g) { return g.first == flag.name; });
    if (!is_given) continue;
    const auto rule = std::find_if(std::begin(kUseRules), std::end(kUseRules),
                                   [&](const UseRule& r) { return r.flag == flag.name; });
    if (rule == std::end(kUseRules) || rule->counts(use)) continue;
    std::string line(flag.name);
    line.append(" has no effect with ").append(rule->of_method ? use.method() : "--spp 1");
    line.append("; it counts ").append(rule->where);
    lines.push_back(std::move(line));
  }
  return lines;
}

bool IsJobFile(std::string_view path) { return Lower(path).ends_with(".json"); }

absl::Status CheckScenePath(std::string_view path) {
  if (IsJobFile(path)) return absl::OkStatus();
  const absl::Status format = SceneFormatOf(std::string(path)).status();
  if (format.ok()) return format;
  return Bad(std::string(format.message()) + "; or name a job file .json");
}

}  // namespace farpoint
