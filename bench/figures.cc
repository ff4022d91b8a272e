#include "bench/figures.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <filesystem>
#include <limits>
#include <nlohmann/json.hpp>
#include <optional>
#include <utility>

#include "absl/strings/str_format.h"
#include "bench/accuracy_frame.h"
#include "bench/accuracy_pictures.h"
#include "bench/micro_workload.h"
#include "core/base/hash.h"
#include "core/image/png_io.h"
#include "core/math/sampling.h"
#include "core/pbgi/microbuffer.h"
#include "core/render/camera_rays.h"
#include "core/scene/procedural.h"

namespace farpoint {
namespace {

using Log = std::function<void(std::string_view)>;

constexpr int kGap = 6;  // pixels between the parts of a picture

// --- Pictures ------------------------------------------------------------------------------------

Picture Blank(int width, int height, uint8_t grey) {
  return {width, height,
          std::vector<uint8_t>(size_t{3} * static_cast<size_t>(width) * static_cast<size_t>(height),
                               grey)};
}

void Paste(Picture& into, const Picture& from, int x0, int y0) {
  for (int y = 0; y < from.height; ++y) {
    std::copy_n(from.rgb.begin() + ptrdiff_t{3} * y * from.width, 3 * from.width,
                into.rgb.begin() + 3 * (ptrdiff_t{y + y0} * into.width + x0));
  }
}

Picture Column(const Picture& top, const Picture& bottom) {
  Picture column = Blank(std::max(top.width, bottom.width), top.height + kGap + bottom.height, 255);
  Paste(column, top, 0, 0);
  Paste(column, bottom, 0, top.height + kGap);
  return column;
}

void SetPixel(Picture& picture, int x, int y, const Rgb& display) {
  if (x < 0 || y < 0 || x >= picture.width || y >= picture.height) return;
  for (int k = 0; k < 3; ++k) {
    picture.rgb[3 * (static_cast<size_t>(y) * static_cast<size_t>(picture.width) +
                     static_cast<size_t>(x)) +
                static_cast<size_t>(k)] =
        static_cast<uint8_t>(std::lround(255.0f * std::clamp(display[k], 0.0f, 1.0f)));
  }
}

// A filled disc with a dark rim.
void Mark(Picture& picture, float cx, float cy, const Rgb& colour) {
  constexpr int kRadius = 5;
  for (int y = -kRadius; y <= kRadius; ++y) {
    for (int x = -kRadius; x <= kRadius; ++x) {
      const int d2 = x * x + y * y;
      if (d2 > kRadius * kRadius) continue;
      SetPixel(picture, static_cast<int>(cx) + x, static_cast<int>(cy) + y,
               d2 > (kRadius - 2) * (kRadius - 2) ? Rgb(0, 0, 0) : colour);
    }
  }
}

// Linear to display; clamped.
float Display(float linear) {
  const float v = std::clamp(linear, 0.0f, 1.0f);
  return v <= 0.0031308f ? 12.92f * v : 1.055f * std::pow(v, 1.0f / 2.4f) - 0.055f;
}
Rgb Display(const Rgb& v) { return {Display(v.x), Display(v.y), Display(v.z)}; }

// A colour that differs from those of most other keys; never dark.
Rgb ColourOf(uint64_t key) {
  const uint64_t bits = HashKey(key, 0x66696775);
  const auto part = [&](int i) { return static_cast<float>(bits >> (i * 16) & 0xffff) / 65536.0f; };
  const float hue = 6 * part(0), value = 0.65f + 0.35f * part(1), grey = 0.1f + 0.35f * part(2);
  Rgb c;
  for (int k = 0; k < 3; ++k) {
    const float at = std::fmod(hue + 2.0f * static_cast<float>(k), 6.0f);
    const float full = std::clamp(std::abs(at - 3.0f) - 1.0f, 0.0f, 1.0f);
    c[k] = value * (grey + (1 - grey) * full);
  }
  return c;
}

class Writer {
 public:
  Writer(std::string folder, FiguresReport& report) : folder_(std::move(folder)), report_(report) {}
  absl::Status Write(const std::string& name, const Picture& picture) {
    report_.files.push_back(name);
    return WritePng((std::filesystem::path(folder_) / name).string(), picture.width, picture.height,
                    picture.rgb);
  }

 private:
  const std::string folder_;
  FiguresReport& report_;
};

// --- How it works: the Cornell box with few surfels ----------------------------------------------

// What a pixel's ray meets.
struct Seen {
  bool hit = false;
  Receiver receiver;
  float t = 0;
};

class Method {
 public:
  Method(const MicroWorkload& work, int side)
      : work_(work),
        side_(side),
        film_{side, side, {0, 0, side, side}},
        rays_(work.description.cameras.front(), film_, work.scene->origin()) {
    std::vector<float> luminances;
    for (uint32_t slot = 0; slot < work.tree->surfel_count(); ++slot) {
      luminances.push_back(Luminance(work.tree->radiance_of(slot, true)));
    }
    const auto bright = luminances.begin() + static_cast<ptrdiff_t>(luminances.size() * 19 / 20);
    std::nth_element(luminances.begin(), bright, luminances.end());
    exposure_ = *bright > 0 ? 1 / *bright : 1;
    seen_.resize(static_cast<size_t>(side) * static_cast<size_t>(side));
    for (int y = 0; y < side; ++y) {
      for (int x = 0; x < side; ++x) Trace(x, y);
    }
  }

  // A dot for each surfel that can be seen, in the colour that it reflects.
  Picture Surfels() const {
    Picture picture = Blank(side_, side_, 24);
    for (uint32_t slot = 0; slot < work_.tree->surfel_count(); ++slot) {
      const Surfel surfel = work_.tree->surfel(slot);
      float cx = 0, cy = 0;
      if (!rays_.RasterOf(surfel.position, cx, cy)) continue;
      const Vec3f to = surfel.position - rays_.eye();
      const float distance = Length(to);
      const bool front = Dot(surfel.normal, to) < 0;
      const Rgb colour = Display(work_.tree->radiance_of(slot, front) * exposure_);
      const int reach = 1 + static_cast<int>(surfel.radius_m / rays_.FootprintAt(surfel.position));
      for (int y = static_cast<int>(cy) - reach; y <= static_cast<int>(cy) + reach; ++y) {
        for (int x = static_cast<int>(cx) - reach; x <= static_cast<int>(cx) + reach; ++x) {
          if (x < 0 || y < 0 || x >= side_ || y >= side_) continue;
          const Seen& seen = At(x, y);
          // Of the surface that the pixel shows, and within half of the disc, so that dots stay
          // apart.
          if (!seen.hit || std::abs(seen.t - distance) > 2 * surfel.radius_m) continue;
          const Vec3f d = seen.receiver.position - surfel.position;
          if (std::abs(Dot(d, surfel.normal)) > 0.1f * surfel.radius_m) continue;
          if (Length(d) < 0.6f * surfel.radius_m) SetPixel(picture, x, y, colour);
        }
      }
    }
    return picture;
  }

  // Each cluster of each block in a colour of its own; the blocks' borders are dark.
  Picture Clusters(uint32_t k) const {
    Picture picture = Blank(side_, side_, 24);
    for (const PixelRect& block : BlocksOf(film_.crop, film_.frame())) {
      std::vector<Receiver> receivers;
      std::vector<std::pair<int, int>> places;
      for (int y = block.y0; y < block.y1; ++y) {
        for (int x = block.x0; x < block.x1; ++x) {
          if (!At(x, y).hit) continue;
          receivers.push_back(At(x, y).receiver);
          places.emplace_back(x, y);
        }
      }
      ClusterParams params;
      params.k = k;
      params.seed_key = HashKey(static_cast<uint64_t>(block.x0), static_cast<uint64_t>(block.y0));
      uint64_t index = 0;
      for (const ReceiverCluster& cluster : ClusterReceivers(receivers, params)) {
        const Rgb colour = ColourOf(HashKey(params.seed_key, index++));
        for (const uint32_t member : cluster.members) {
          const auto [x, y] = places[member];
          const bool border = x == block.x0 || y == block.y0;
          SetPixel(picture, x, y, border ? colour * 0.45f : colour);
        }
      }
    }
    return picture;
  }

  // What a receiver sees of the tree: every visible surface in the colour of the node of the cut
  // that stands for it.
  Picture Cut(const Receiver& receiver) const {
    CutView view;
    view.position = receiver.position;
    view.normal = receiver.normal;
    std::vector<CutNode> cut;
    CutCounters counters;
    CutParams params = work_.cut_params(BufferMap::kOctahedral);
    // What lies below the receiver's horizon or looks away belongs to the picture, too.
    params.skip_below_horizon = params.skip_invisible_side = false;
    ComputeClusterCut(*work_.tree, view, params, cut, nullptr, counters);
    const std::vector<Rgb> colour_of = ColoursOfSurfels(cut);
    Picture picture = Blank(side_, side_, 24);
    for (int y = 0; y < side_; ++y) {
      for (int x = 0; x < side_; ++x) {
        if (!At(x, y).hit) continue;
        const std::optional<uint32_t> slot = NearestSurfel(At(x, y).receiver);
        if (!slot) continue;
        const float shade = 0.75f + 0.25f * At(x, y).receiver.normal.y;
        SetPixel(picture, x, y, colour_of[*slot] * shade);
      }
    }
    float cx = 0, cy = 0;
    if (rays_.RasterOf(receiver.position, cx, cy)) Mark(picture, cx, cy, {1, 1, 1});
    return picture;
  }

  // The shared buffer of a cluster, its receiver's own, and what both are together. Of all clusters
  // the one of which the lesser of both says most.
  absl::StatusOr<Picture> Microbuffers() const {
    Microbuffer shared(work_.octahedral), alone(work_.octahedral);
    const ClusterViews* chosen = nullptr;
    double most = 0;
    for (const ClusterViews& views : work_.cluster_views) {
      Fill(views, shared, alone);
      const double lesser = std::min(Sum(shared), Sum(alone));
      if (lesser <= most) continue;
      most = lesser;
      chosen = &views;
    }
    if (chosen == nullptr) {
      return absl::InternalError("figures: no cluster of the Cornell box has both buffers");
    }
    Fill(*chosen, shared, alone);
    const int side = static_cast<int>(work_.octahedral.side());
    std::array<Picture, 3> parts;
    parts.fill(Blank(side, side, 24));
    for (int y = 0; y < side; ++y) {
      for (int x = 0; x < side; ++x) {
        const auto i = static_cast<size_t>(y * side + x);
        const float c_far = std::min(1.0f, shared.coverage()[i]);
        const float c_near = std::min(1.0f, alone.coverage()[i]);
        const Rgb l_far(shared.radiance(0)[i], shared.radiance(1)[i], shared.radiance(2)[i]);
        const Rgb l_near(alone.radiance(0)[i], alone.radiance(1)[i], alone.radiance(2)[i]);
        const float room = c_far > 0 ? std::min(1.0f, (1 - c_near) / c_far) : 0;
        // Nothing is dark blue, so that it is not taken for black.
        const Rgb nothing(0.02f, 0.03f, 0.08f);
        const auto paint = [&](Picture& part, const Rgb& value, float coverage) {
          SetPixel(part, x, y, Display(value * exposure_ + nothing * std::max(0.0f, 1 - coverage)));
        };
        paint(parts[0], l_far, c_far);
        paint(parts[1], l_near, c_near);
        paint(parts[2], l_near + l_far * room, c_near + room * c_far);
      }
    }
    std::vector<Picture> enlarged;
    for (const Picture& part : parts) {
      enlarged.push_back(Enlarged(part, {0, 0, side, side}, 256 / side));
    }
    return SideBySide(enlarged);
  }

  // What the pixel's ray meets.
  const Seen& At(int x, int y) const {
    return seen_[static_cast<size_t>(y) * static_cast<size_t>(side_) + static_cast<size_t>(x)];
  }

 private:
  void Trace(int x, int y) {
    const Vec3f w = rays_.Direction(x + 0.5, y + 0.5);
    const std::optional<RayHit> hit = FirstSeen(*work_.accel, rays_.eye(), w);
    if (!hit) return;
    Seen& seen =
        seen_[static_cast<size_t>(y) * static_cast<size_t>(side_) + static_cast<size_t>(x)];
    seen.hit = true;
    seen.t = hit->t;
    Receiver& r = seen.receiver;
    r.position = work_.scene->PointOn(hit->triangle, hit->b1, hit->b2);
    r.geometric_normal = work_.scene->GeometricNormal(hit->triangle);
    r.normal = work_.scene->ShadingNormal(hit->triangle, hit->b1, hit->b2);
    r.on_back = Dot(r.geometric_normal, w) > 0.0f;
    if (r.on_back) {
      r.geometric_normal = -r.geometric_normal;
      r.normal = -r.normal;
    }
  }

  // The cluster's buffer and that of its first receiver, as core/render makes them.
  void Fill(const ClusterViews& views, Microbuffer& shared, Microbuffer& alone) const {
    std::vector<CutNode> far, own, scratch;
    std::vector<NearNode> near;
    const CutParams params = work_.cut_params(BufferMap::kOctahedral);
    CutCounters cut_counters;
    RasterCounters raster_counters;
    shared.Clear();
    alone.Clear();
    ComputeClusterCut(*work_.tree, views.view, params, far, &near, cut_counters);
    SortFrontToBack(far, scratch);
    RasterizeCut(*work_.tree, views.view, far, Splat::kCoverage, shared, raster_counters);
    ComputeReceiverCut(*work_.tree, views.members.front(), params, views.near, own, cut_counters);
    SortFrontToBack(own, scratch);
    RasterizeCut(*work_.tree, views.members.front(), own, Splat::kCoverage, alone, raster_counters);
  }
  static double Sum(const Microbuffer& buffer) {
    double sum = 0;
    for (uint32_t i = 0; i < buffer.map().pixels(); ++i) sum += buffer.coverage()[i];
    return sum;
  }

  // By slot of a surfel.
  std::vector<Rgb> ColoursOfSurfels(const std::vector<CutNode>& cut) const {
    const PointTree& tree = *work_.tree;
    std::vector<Rgb> colours(tree.surfel_count(), Rgb(0.1f, 0.1f, 0.1f));
    for (const CutNode& node : cut) {
      int level = 0;
      while (level + 1 < tree.levels() && node.slot / kLanes >= tree.first_group(level + 1)) {
        ++level;
      }
      // Surfels of a node: its index within its level, times eight for each level below it.
      uint64_t first = node.slot - uint64_t{tree.first_group(level)} * kLanes, count = 1;
      for (int i = 0; i < level; ++i) first *= kLanes, count *= kLanes;
      const Rgb colour = ColourOf(node.slot);
      for (uint64_t i = first; i < std::min<uint64_t>(first + count, colours.size()); ++i) {
        colours[i] = colour;
      }
    }
    return colours;
  }

  // Of the same side as the receiver.
  std::optional<uint32_t> NearestSurfel(const Receiver& receiver) const {
    std::optional<uint32_t> nearest;
    float least = std::numeric_limits<float>::infinity();
    for (uint32_t slot = 0; slot < work_.tree->surfel_count(); ++slot) {
      const Surfel surfel = work_.tree->surfel(slot);
      const Vec3f d = surfel.position - receiver.position;
      const float d2 = Dot(d, d);
      if (d2 >= least || std::abs(Dot(surfel.normal, receiver.geometric_normal)) < 0.9f) continue;
      least = d2;
      nearest = slot;
    }
    return nearest;
  }

  const MicroWorkload& work_;
  const int side_;
  const FilmSpec film_;
  const CameraRays rays_;
  std::vector<Seen> seen_;
  float exposure_ = 1;  // the brightest twentieth of the surfels is white
};

absl::Status DrawMethod(const FiguresOptions& options, Writer& writer, const Log& log) {
  log("how it works: surfels, clusters, cut, microbuffers");
  // So few surfels that each can be seen.
  FP_ASSIGN_OR_RETURN(const auto few, MicroWorkload::Make(true));
  const int side = 2 * options.side_px;
  const Method method(*few, side);
  FP_RETURN_IF_ERROR(writer.Write("surfels.png", method.Surfels()));
  const Picture clusters = Method(*few, options.side_px).Clusters(16);
  FP_RETURN_IF_ERROR(writer.Write("clusters.png",
                                  Enlarged(clusters, {0, 0, options.side_px, options.side_px}, 2)));
  const Seen& floor = method.At(side / 4, side - side / 6);
  const Seen& block = method.At(side / 2, side - side / 10);
  if (!floor.hit || !block.hit) return absl::InternalError("figures: the floor is not seen");
  FP_RETURN_IF_ERROR(writer.Write(
      "cut.png", SideBySide({method.Cut(floor.receiver), method.Cut(block.receiver)})));
  FP_ASSIGN_OR_RETURN(const auto many, MicroWorkload::Make(options.quick));
  FP_ASSIGN_OR_RETURN(const Picture buffers, Method(*many, options.side_px).Microbuffers());
  return writer.Write("microbuffers.png", buffers);
}

// --- Parameters ----------------------------------------------------------------------------------

struct Variant {
  const char* parameter;
  std::string value;
  RenderSettings settings;
};

std::vector<Variant> Variants(bool quick) {
  RenderSettings paper_like;  // the paper's way: k clusters per block, filled by cuts
  paper_like.clusters = 100;
  paper_like.epsilon = 0.2f;
  paper_like.points = quick ? 2'000 : 100'000;
  std::vector<Variant> variants;
  const auto add = [&](const char* parameter, const std::string& value, RenderSettings settings) {
    variants.push_back({parameter, value, std::move(settings)});
  };
  for (const Quality quality : {Quality::kDraft, Quality::kNormal, Quality::kFine}) {
    RenderSettings s;
    s.quality = quality;
    add("--quality", std::string(NameOf(quality)), s);
  }
  for (const uint32_t k : {4u, 25u, 100u, 400u}) {
    if (quick && k > 100) continue;
    RenderSettings s = paper_like;
    s.clusters = k;
    add("--clusters", std::to_string(k), s);
  }
  for (const float epsilon : {0.05f, 0.1f, 0.2f, 0.4f}) {
    if (quick && epsilon < 0.1f) continue;
    RenderSettings s = paper_like;
    s.epsilon = epsilon;
    add("--epsilon", absl::StrFormat("%g", epsilon), s);
  }
  for (const uint32_t side : {8u, 16u, 32u, 64u}) {
    if (quick && side > 32) continue;
    RenderSettings s = paper_like;
    s.microbuffer = side;
    add("--microbuffer", std::to_string(side), s);
  }
  for (const uint64_t points : {1'000u, 10'000u, 100'000u, 1'000'000u}) {
    if (quick && points > 10'000) continue;
    RenderSettings s = paper_like;
    s.points = points;
    add("--points", std::to_string(points), s);
  }
  return variants;
}

constexpr float kFullError = 0.2f;  // of the mean: full blue or red

struct Truth {
  Film film;
  double mean = 0, noise = 0;  // noise: root mean square standard error over mean
};

// Of all channels and pixels.
template <typename F>
double MeanOver(const PixelRect& rect, F&& value) {
  double sum = 0;
  for (int y = rect.y0; y < rect.y1; ++y) {
    for (int x = rect.x0; x < rect.x1; ++x) {
      for (int c = 0; c < 3; ++c) sum += value(c, x, y);
    }
  }
  return sum / (3.0 * static_cast<double>(rect.area()));
}

absl::StatusOr<Truth> MakeTruth(const FiguresOptions& options, const Scene& scene,
                                Executor& executor, const Log& log) {
  log(absl::StrFormat("reference: %d paths a pixel", options.paths));
  RenderSettings settings;
  settings.integrator = Integrator::kPt;
  settings.paths = options.paths;
  settings.seed = options.seed + 1;
  settings.layers = {Layer::kBeauty, Layer::kDirect, Layer::kIndirect, Layer::kIrradiance,
                     Layer::kStdError};
  FP_ASSIGN_OR_RETURN(const LoadedFrame loaded,
                      LoadFrame(scene, scene.cameras.front(), options.side_px, options.side_px,
                                settings, nullptr, executor));
  FP_ASSIGN_OR_RETURN(RenderedFrame rendered, RenderByTiles(loaded.frame, settings, executor));
  Truth truth{std::move(rendered.film)};
  const PixelRect& rect = truth.film.rect();
  truth.mean = MeanOver(
      rect, [&](int c, int x, int y) { return truth.film.Get(Layer::kIrradiance, c, x, y); });
  const double squares = MeanOver(rect, [&](int c, int x, int y) {
    const double e = truth.film.Get(Layer::kStdError, c, x, y);
    return e * e;
  });
  if (!(truth.mean > 0)) return absl::InternalError("figures: the reference is black");
  truth.noise = std::sqrt(squares) / truth.mean;
  return truth;
}

// The part with both shadow and contact.
Picture Detail(const Picture& whole) {
  const int size = whole.width / 2;
  return Enlarged(whole,
                  {whole.width / 4, whole.height - size, whole.width / 4 + size, whole.height},
                  whole.width >= 256 ? 1 : 2);
}

absl::Status DrawParameters(const FiguresOptions& options, Writer& writer, FiguresReport& report,
                            const Log& log) {
  Executor executor(options.threads);
  const Scene scene = MakeCornellBox();
  FP_ASSIGN_OR_RETURN(const Truth truth, MakeTruth(options, scene, executor, log));
  report.noise = truth.noise;
  const float white = 1.1f * LuminanceQuantile(truth.film, Layer::kIrradiance, 0.98);
  const float beauty_white = LuminanceQuantile(truth.film, Layer::kBeauty, 0.95);

  std::vector<Picture> parts;
  std::string parameter;
  const auto flush = [&]() -> absl::Status {
    if (parts.empty()) return absl::OkStatus();
    parts.push_back(Detail(ColourPicture(truth.film, Layer::kIrradiance, white)));
    const Picture row = SideBySide(parts);
    parts.clear();
    return writer.Write("parameter-" + parameter.substr(2) + ".png", row);
  };
  for (Variant& variant : Variants(options.quick)) {
    if (variant.parameter != parameter) {
      FP_RETURN_IF_ERROR(flush());
      parameter = variant.parameter;
    }
    log(parameter + " " + variant.value);
    RenderSettings& settings = variant.settings;
    settings.seed = options.seed;
    settings.layers = {Layer::kBeauty, Layer::kDirect, Layer::kIndirect, Layer::kEmission,
                       Layer::kIrradiance};
    FP_ASSIGN_OR_RETURN(const LoadedFrame loaded,
                        LoadFrame(scene, scene.cameras.front(), options.side_px, options.side_px,
                                  settings, nullptr, executor));
    FP_ASSIGN_OR_RETURN(const RenderedFrame rendered,
                        RenderByTiles(loaded.frame, settings, executor));
    const auto difference = [&](int c, int x, int y) {
      return double{rendered.film.Get(Layer::kIrradiance, c, x, y)} -
             truth.film.Get(Layer::kIrradiance, c, x, y);
    };
    const PixelRect& rect = truth.film.rect();
    const double rel = std::sqrt(MeanOver(rect,
                                          [&](int c, int x, int y) {
                                            const double d = difference(c, x, y);
                                            return d * d;
                                          })) /
                       truth.mean;
    report.rows.push_back({.parameter = parameter,
                           .value = variant.value,
                           .gather_s = GatherSeconds(rendered.stats),
                           .bake_s = BakeSeconds(loaded.bake),
                           .rr = std::sqrt(std::max(0.0, rel * rel - truth.noise * truth.noise)),
                           .bias = MeanOver(rect, difference) / truth.mean});
    // Above what is rendered, below by how much of the mean it is wrong.
    std::vector<float> errors;
    for (int y = rect.y0; y < rect.y1; ++y) {
      for (int x = rect.x0; x < rect.x1; ++x) {
        const double sum = difference(0, x, y) + difference(1, x, y) + difference(2, x, y);
        errors.push_back(static_cast<float>(sum / (3 * truth.mean)));
      }
    }
    parts.push_back(Column(Detail(ColourPicture(rendered.film, Layer::kIrradiance, white)),
                           Detail(DenseErrorPicture(rect, errors, kFullError))));
    if (parameter == "--quality" && variant.value == "normal") {
      FP_RETURN_IF_ERROR(writer.Write(
          "layers.png", SideBySide({ColourPicture(rendered.film, Layer::kDirect, beauty_white),
                                    ColourPicture(rendered.film, Layer::kIndirect, beauty_white),
                                    ColourPicture(rendered.film, Layer::kBeauty, beauty_white)})));
    }
  }
  return flush();
}

// --- More than one bounce, and what is open ------------------------------------------------------

constexpr std::array<uint32_t, 3> kBounces = {1, 2, 8};

absl::StatusOr<Film> RenderBox(const FiguresOptions& options, const RenderSettings& settings,
                               Executor& executor) {
  const Scene scene = MakeCornellBox();
  FP_ASSIGN_OR_RETURN(const LoadedFrame loaded,
                      LoadFrame(scene, scene.cameras.front(), options.side_px, options.side_px,
                                settings, nullptr, executor));
  FP_ASSIGN_OR_RETURN(RenderedFrame rendered, RenderByTiles(loaded.frame, settings, executor));
  return std::move(rendered.film);
}

absl::Status DrawLight(const FiguresOptions& options, Writer& writer, const Log& log) {
  Executor executor(options.threads);
  std::vector<Picture> parts;
  float white = 0;
  for (const uint32_t bounces : kBounces) {
    log(absl::StrFormat("bounces %d", bounces));
    RenderSettings settings;
    settings.bounces = bounces;
    settings.seed = options.seed;
    settings.layers = {Layer::kBeauty};
    FP_ASSIGN_OR_RETURN(const Film film, RenderBox(options, settings, executor));
    if (parts.empty()) white = LuminanceQuantile(film, Layer::kBeauty, 0.95);
    parts.push_back(ColourPicture(film, Layer::kBeauty, white));
  }
  FP_RETURN_IF_ERROR(writer.Write("bounces.png", SideBySide(parts)));
  parts.clear();
  for (const Integrator integrator : {Integrator::kFpbgi, Integrator::kPt}) {
    log("ambient occlusion, " + std::string(NameOf(integrator)));
    RenderSettings settings;
    settings.integrator = integrator;
    settings.paths = options.paths;
    settings.seed = options.seed;
    settings.layers = {Layer::kAmbientOcclusion};
    FP_ASSIGN_OR_RETURN(const Film film, RenderBox(options, settings, executor));
    Picture picture = Blank(options.side_px, options.side_px, 0);
    for (int y = 0; y < options.side_px; ++y) {
      for (int x = 0; x < options.side_px; ++x) {
        SetPixel(picture, x, y, Rgb(film.Get(Layer::kAmbientOcclusion, 0, x, y)));
      }
    }
    parts.push_back(std::move(picture));
  }
  return writer.Write("ambient-occlusion.png", SideBySide(parts));
}

}  // namespace

absl::StatusOr<FiguresReport> RunFigures(const FiguresOptions& options, const std::string& folder,
                                         const Log& log) {
  FiguresReport report{options};
  if (options.quick) {
    report.options.side_px = 64;
    report.options.paths = 256;
  }
  Writer writer(folder, report);
  FP_RETURN_IF_ERROR(DrawMethod(report.options, writer, log));
  FP_RETURN_IF_ERROR(DrawParameters(report.options, writer, report, log));
  FP_RETURN_IF_ERROR(DrawLight(report.options, writer, log));
  return report;
}

std::string FiguresTables(const FiguresReport& report) {
  std::string text;
  std::string parameter;
  for (const FigureRow& row : report.rows) {
    if (row.parameter != parameter) {
      parameter = row.parameter;
      absl::StrAppendFormat(&text,
                            "%s| `%s` | gather, thread-s | bake, thread-s | rr | bias |\n"
                            "|---|---|---|---|---|\n",
                            text.empty() ? "" : "\n", parameter);
    }
    absl::StrAppendFormat(&text, "| %s | %.2f | %.2f | %.1f %% | %+.1f %% |\n", row.value,
                          row.gather_s, row.bake_s, 100 * row.rr, 100 * row.bias);
  }
  absl::StrAppendFormat(&text, "\nreference: %d paths, noise %.2f %% (taken out of rr)\n",
                        report.options.paths, 100 * report.noise);
  return text;
}

std::string FiguresJson(const FiguresReport& report) {
  nlohmann::ordered_json json;
  json["side_px"] = report.options.side_px;
  json["paths"] = report.options.paths;
  json["seed"] = report.options.seed;
  json["noise"] = report.noise;
  json["files"] = report.files;
  for (const FigureRow& row : report.rows) {
    json["rows"].push_back({{"parameter", row.parameter},
                            {"value", row.value},
                            {"gather_s", row.gather_s},
                            {"bake_s", row.bake_s},
                            {"rr", row.rr},
                            {"bias", row.bias}});
  }
  return json.dump(2) + "\n";
}

}  // namespace farpoint
