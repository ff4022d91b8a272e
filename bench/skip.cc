#include "bench/skip.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <filesystem>
#include <optional>
#include <span>
#include <utility>

#include "absl/strings/str_format.h"
#include "absl/strings/str_join.h"
#include "bench/accuracy_frame.h"
#include "bench/bench_scene.h"
#include "bench/machine.h"
#include "bench/skip_scenes.h"
#include "bench/text.h"
#include "core/base/clock.h"
#include "core/base/executor.h"
#include "core/image/film.h"
#include "core/render/bake.h"
#include "core/render/bake_cache.h"
#include "core/scene/procedural.h"

namespace farpoint {

namespace {

constexpr uint64_t kCacheBytes = uint64_t{1} << 30;

// What is timed.
enum class Timed {
  kFrame,      // rendering, after one bake for all rounds
  kBake,       // the bake alone, cold
  kBakeAgain,  // the bake of what was baked before, with a cache
  kBakeFirst,  // the same with a cache that is empty
};

struct Subject {
  std::string scene;  // in words
  std::function<Scene()> make;
  Timed timed = Timed::kFrame;
  std::function<void(RenderSettings&)> settings;
  int wider = 1;  // times the width and height of the others' frames
};

struct Item {
  std::string_view name;
  SkipMask mask;
  std::string_view counter, what;
  double rr_bar;  // 0: exact
  std::vector<Subject> profits, plain;
};

void ByPbgi(RenderSettings& s) { s.integrator = Integrator::kPbgi; }
void ByPt(RenderSettings& s) { s.integrator = Integrator::kPt; }
void DirectOnly(RenderSettings& s) {
  s.integrator = Integrator::kPt;
  s.layers = {Layer::kDirectIrradiance};
}
void BeautyOfRecords(RenderSettings& s) { s.layers = {Layer::kBeauty}; }
void BeautyOfPbgi(RenderSettings& s) {
  ByPbgi(s);
  s.layers = {Layer::kBeauty};
}

double Quantile(std::vector<double> values, double q) {
  std::sort(values.begin(), values.end());
  const double at = q * static_cast<double>(values.size() - 1);
  const auto low = static_cast<size_t>(at);
  const size_t high = std::min(low + 1, values.size() - 1);
  return values[low] + (at - static_cast<double>(low)) * (values[high] - values[low]);
}

class Runner {
 public:
  Runner(const SkipOptions& options, const std::function<void(std::string_view)>& progress,
         SkipReport& report)
      : options_(options), progress_(progress), report_(report), executor_(options.threads) {
    report_.threads = executor_.threads();
  }

  std::vector<Item> Items() {
    const bool quick = options_.quick;
    const auto cornell = [](std::string_view how, auto settings, Timed timed = Timed::kFrame) {
      return Subject{Concat({"Cornell box, ", how}), MakeCornellBox, timed, settings};
    };
    std::vector<Item> items;
    items.push_back({"black-receivers",
                     kSkipBlack,
                     "black_receivers",
                     "no light is gathered at receivers that reflect nothing",
                     0,
                     {{"Cornell box, all black but the floor; pbgi", MakeBlackBox, Timed::kFrame,
                       BeautyOfPbgi}},
                     {cornell("pbgi", BeautyOfPbgi)}});
    items.push_back(
        {"black-hits",
         kSkipBlack,
         "black_hits",
         "paths that end on what reflects nothing ask for no light",
         0,
         {{"Cornell box, all black but the floor; pt", MakeBlackBox, Timed::kFrame, ByPt}},
         {{"floor under one light; pt", MakeLitFloor, Timed::kFrame, ByPt}}});
    items.push_back({"idle-blocks",
                     kSkipIdleBlocks,
                     "blocks_without_gather",
                     "no records where no receiver of a block shows indirect light",
                     0,
                     {{"Cornell box behind a lamp; fpbgi", MakeLampBeforeBox, Timed::kFrame,
                       BeautyOfRecords, 2}},
                     {{"Cornell box, fpbgi", MakeCornellBox, Timed::kFrame, BeautyOfRecords, 2}}});
    items.push_back({"unlit",
                     kSkipUnlit,
                     "unlit_receivers",
                     "no gather without light",
                     0,
                     {{"Cornell box without its light; pbgi", MakeDarkBox, Timed::kFrame, ByPbgi}},
                     {cornell("pbgi", ByPbgi)}});
    items.push_back({"unlit-bake",
                     kSkipUnlit,
                     "bakes_without_light",
                     "no surfels and no tree without light",
                     0,
                     {{"Cornell box without its light; bake", MakeDarkBox, Timed::kBake, ByPbgi}},
                     {cornell("bake", ByPbgi, Timed::kBake)}});
    items.push_back({"below-horizon",
                     kSkipBelowHorizon,
                     "nodes_below_horizon",
                     "nodes below the horizons of all receivers",
                     0.05,
                     {{"boxes on a floor; pbgi", [=] { return MakeBoxes(quick ? 4 : 12); },
                       Timed::kFrame, ByPbgi}},
                     {}});
    items.push_back(
        {"invisible-sides",
         kSkipInvisibleSide,
         "nodes_invisible_side",
         "nodes of which only sides inside closed objects are seen",
         0,
         {{"boxes on a floor; pbgi", [=] { return MakeBoxes(quick ? 4 : 12); }, Timed::kFrame,
           ByPbgi}},
         {{"furnace; pbgi", [] { return MakeFurnace(0.5f, 1.0f); }, Timed::kFrame, ByPbgi}}});
    Item hidden{"hidden-nodes",
                kSkipHidden,
                "nodes_hidden",
                "nodes and subtrees behind a filled part of the buffer",
                0,
                {{Concat({quick ? "3 x 3" : "7 x 7", " closed rooms; pbgi"}),
                  [=] { return MakeRooms(quick ? 3 : 7); }, Timed::kFrame, ByPbgi}},
                {{"furnace; pbgi", [] { return MakeFurnace(0.5f, 1.0f); }, Timed::kFrame, ByPbgi},
                 cornell("pbgi", ByPbgi)}};
    if (!quick) {
      hidden.profits.push_back(
          {"city; pbgi", [] { return MakeCity(4, 1); }, Timed::kFrame, ByPbgi});
      hidden.profits.push_back({"city; k = 100 clusters of cuts", [] { return MakeCity(4, 1); },
                                Timed::kFrame,
                                [](RenderSettings& s) {
                                  s.integrator = Integrator::kFpbgi;
                                  s.clusters = 100;
                                }});
      if (const std::optional<Scene> sponza = Sponza()) {
        hidden.profits.push_back({"Sponza; pbgi", [=] { return *sponza; }, Timed::kFrame, ByPbgi});
        hidden.profits.push_back({"Sponza; records filled by cuts", [=] { return *sponza; },
                                  Timed::kFrame,
                                  [](RenderSettings& s) {
                                    s.integrator = Integrator::kFpbgi;
                                    s.fill = Fill::kCut;
                                  }});
      }
    }
    items.push_back(std::move(hidden));
    items.push_back(
        {"shadow-rays",
         kSkipShadowRays,
         "shadow_rays",
         "shadow rays of lights that cannot reach: behind, outside the cone, too far",
         0,
         {{"Cornell box, eight spots that point aside; direct light", MakeSpotsAside, Timed::kFrame,
           DirectOnly}},
         {{"floor under one light; direct light", MakeLitFloor, Timed::kFrame, DirectOnly}}});
    items.push_back(
        {"environment",
         kSkipEnvironment,
         "environment_terms",
         "no rays to an environment that is not there",
         0,
         {cornell("direct light", DirectOnly)},
         {{"floor under a sky; direct light", MakeOpenFloor, Timed::kFrame, DirectOnly}}});
    items.push_back(
        {"textures",
         kSkipTextures,
         "textures",
         "textures that no surface shows are not decoded",
         0,
         {{"Cornell box with 8 unused textures; bake",
           [=] { return MakeUnusedTextures(8, quick ? 64 : 1024); }, Timed::kBake, ByPbgi}},
         {cornell("bake", ByPbgi, Timed::kBake)}});
    items.push_back({"bake-stages",
                     kSkipBakeStages,
                     "bake_stages",
                     "stages of a bake whose product an earlier one left",
                     0,
                     {cornell("bake of the same again", ByPbgi, Timed::kBakeAgain)},
                     {cornell("first bake with a cache", ByPbgi, Timed::kBakeFirst)}});
    return items;
  }

  absl::Status Run(const Item& item) {
    SkipRow row;
    row.name = item.name;
    row.counter = item.counter;
    row.what = item.what;
    row.exact = item.rr_bar == 0;
    row.rr_bar = item.rr_bar;
    for (const Subject& s : item.profits) FP_RETURN_IF_ERROR(AddSide(item, s, true, row));
    for (const Subject& s : item.plain) FP_RETURN_IF_ERROR(AddSide(item, s, false, row));
    report_.rows.push_back(std::move(row));
    return absl::OkStatus();
  }

 private:
  // One run, with or without the item.
  struct Sample {
    double seconds = 0;
    Stats stats;
    Film film;
    Digest hash;
  };

  absl::Status AddSide(const Item& item, const Subject& subject, bool profits, SkipRow& row) {
    progress_(Concat({item.name, ": ", subject.scene}));
    const Scene scene = subject.make();
    RenderSettings settings;
    settings.points = options_.points;
    settings.light_samples = options_.light_samples;
    settings.seed = options_.seed;
    settings.layers = {Layer::kIrradiance, Layer::kDirectIrradiance};
    if (subject.settings) subject.settings(settings);
    RenderSettings without = settings;
    without.computed = item.mask;

    std::optional<LoadedFrame> loaded;
    BakeCache cache(kCacheBytes);
    if (subject.timed == Timed::kFrame) {
      const int side = subject.wider * (options_.quick ? 32 : 64);
      // Baked without the item, so that there is something to compute.
      FP_ASSIGN_OR_RETURN(
          loaded, LoadFrame(scene, scene.cameras.front(), side, side, without, nullptr, executor_));
    } else if (subject.timed == Timed::kBakeAgain) {
      FP_RETURN_IF_ERROR(BakeOnce(scene, settings, &cache).status());
    }
    const auto run = [&](const RenderSettings& s) -> absl::StatusOr<Sample> {
      if (loaded) return RenderOnce(loaded->frame, s);
      if (subject.timed == Timed::kBakeAgain) return BakeOnce(scene, s, &cache);
      if (subject.timed == Timed::kBakeFirst) {
        BakeCache empty(kCacheBytes);
        return BakeOnce(scene, s, &empty);
      }
      return BakeOnce(scene, s, nullptr);
    };

    SkipSide side;
    side.profits = profits;
    side.scene = subject.scene;
    std::vector<double> with_s, without_s, ratio;
    // What is made once and kept, such as the surfels about a triangle, belongs to no round.
    if (loaded && !options_.quick) FP_RETURN_IF_ERROR(run(settings).status());
    for (uint32_t round = 0; round < options_.repeat; ++round) {
      std::array<Sample, 2> sample;  // with, without; the first goes first in turn
      for (const size_t which : {round % 2, 1 - round % 2}) {
        FP_ASSIGN_OR_RETURN(sample[which], run(which == 0 ? settings : without));
      }
      with_s.push_back(sample[0].seconds);
      without_s.push_back(sample[1].seconds);
      if (sample[1].seconds > 0) ratio.push_back(sample[0].seconds / sample[1].seconds);
      if (round > 0) continue;
      const auto counted = sample[0].stats.skipped.find(std::string(item.counter));
      side.skipped = counted == sample[0].stats.skipped.end() ? 0 : counted->second;
      side.bits_equal = sample[0].hash == sample[1].hash;
      if (!side.bits_equal && loaded) Compare(sample[0].film, sample[1].film, side);
    }
    side.with_s = Quantile(with_s, 0.5);
    side.without_s = Quantile(without_s, 0.5);
    if (!ratio.empty()) {
      side.ratio = Quantile(ratio, 0.5);
      side.ratio_low = Quantile(ratio, 0.25);
      side.ratio_high = Quantile(ratio, 0.75);
    }
    row.sides.push_back(std::move(side));
    return absl::OkStatus();
  }

  absl::StatusOr<Sample> RenderOnce(const SparseFrame& frame, const RenderSettings& settings) {
    Sample sample;
    const double start = ProcessCpuSeconds();
    FP_ASSIGN_OR_RETURN(RenderedFrame rendered, RenderByTiles(frame, settings, executor_));
    sample.seconds = ProcessCpuSeconds() - start;
    sample.stats = std::move(rendered.stats);
    sample.film = std::move(rendered.film);
    sample.hash = ImageHash(sample.film);
    return sample;
  }

  absl::StatusOr<Sample> BakeOnce(const Scene& scene, const RenderSettings& settings,
                                  BakeCache* cache) {
    Sample sample;
    BakeOptions options;
    options.cache = cache;
    const double start = ProcessCpuSeconds();
    FP_ASSIGN_OR_RETURN(const BakedScene baked,
                        Bake(scene, settings, executor_, sample.stats, options));
    sample.seconds = ProcessCpuSeconds() - start;
    Sha256 hash;
    // Without light there is no tree at all, and one of black surfels otherwise: the same frames.
    std::vector<Blob> blobs = {baked.prepared_scene};
    if (sample.stats.skipped["bakes_without_light"] == 0 && HasLight(scene)) {
      blobs.push_back(baked.tree_topology);
      blobs.push_back(baked.tree_radiance);
    }
    for (const Blob& blob : blobs) {
      const Digest digest = blob.Hash();
      hash.Update(std::as_bytes(std::span(digest.bytes)));
    }
    sample.hash = hash.Finish();
    return sample;
  }

  static bool HasLight(const Scene& scene) {
    return !scene.lights.empty() || MaxComponent(scene.environment.sky) > 0 ||
           std::any_of(scene.materials.begin(), scene.materials.end(),
                       [](const Material& m) { return MaxComponent(m.emission) > 0; });
  }

  static void Compare(const Film& a, const Film& b, SkipSide& side) {
    double square = 0, difference = 0, sum = 0, n = 0;
    for (const Layer layer : a.layers()) {
      for (int c = 0; c < 3; ++c) {
        const auto pa = a.Plane(layer, c), pb = b.Plane(layer, c);
        for (size_t i = 0; i < pa.size(); ++i) {
          const double d = static_cast<double>(pa[i]) - static_cast<double>(pb[i]);
          square += d * d;
          difference += d;
          sum += static_cast<double>(pb[i]);
          n += 1;
        }
      }
      break;  // the first layer: indirect irradiance, where that is rendered
    }
    if (!(sum > 0)) return;
    side.rr = std::sqrt(square * n) / sum;
    side.bias = difference / sum;
  }

  std::optional<Scene> Sponza() {
    const std::string path =
        (std::filesystem::path(options_.scenes_dir) / "sponza/Sponza.gltf").string();
    std::error_code error;
    if (options_.scenes_dir.empty() || !std::filesystem::exists(path, error)) {
      report_.left_out.push_back({"sponza", options_.scenes_dir.empty()
                                                ? "no folder of scenes, give --scenes"
                                                : path + " is not there"});
      return std::nullopt;
    }
    SceneChanges changes;
    changes.sun = AccuracySun{{0.3, 1, 0.1}, Rgb(10, 10, 10)};
    changes.view = AccuracyView{{9, 0.8, -0.3}, {-8, 4, -0.3}, 57};
    absl::StatusOr<BenchScene> made = MakeBenchScene(path, false, changes);
    if (!made.ok()) {
      report_.left_out.push_back({"sponza", std::string(made.status().message())});
      return std::nullopt;
    }
    return std::move(made->scene);
  }

  const SkipOptions& options_;
  const std::function<void(std::string_view)>& progress_;
  SkipReport& report_;
  Executor executor_;
};

constexpr std::string_view kNames[] = {
    "black-receivers", "black-hits",   "idle-blocks", "unlit",       "unlit-bake", "below-horizon",
    "invisible-sides", "hidden-nodes", "shadow-rays", "environment", "textures",   "bake-stages"};

}  // namespace

std::vector<std::string> SkipRow::failures() const {
  std::vector<std::string> out;
  for (const SkipSide& side : sides) {
    if (exact && !side.bits_equal) out.push_back(Concat({side.scene, ": bits differ"}));
    if (!exact && !(side.rr <= rr_bar)) {
      out.push_back(absl::StrFormat("%s: rr %.3g is above %.3g", side.scene, side.rr, rr_bar));
    }
    if (side.profits && side.skipped == 0) {
      out.push_back(Concat({side.scene, ": ", counter, " counted nothing"}));
    }
  }
  return out;
}

size_t SkipReport::failures() const {
  size_t sum = 0;
  for (const SkipRow& row : rows) sum += row.failures().size();
  return sum;
}

std::vector<std::string> SkipNames() { return {std::begin(kNames), std::end(kNames)}; }

absl::StatusOr<SkipReport> RunSkip(const SkipOptions& asked,
                                   const std::function<void(std::string_view)>& progress) {
  SkipReport report;
  report.options = asked;
  SkipOptions& options = report.options;
  if (options.points == 0) options.points = options.quick ? 3'000 : 100'000;
  if (options.repeat == 0) options.repeat = options.quick ? 1 : 7;
  if (options.cases.empty()) options.cases = SkipNames();
  const std::vector<std::string> names = SkipNames();
  for (const std::string& name : options.cases) {
    if (std::find(names.begin(), names.end(), name) == names.end()) {
      return absl::InvalidArgumentError(
          Concat({"--case ", name, " is none of ", absl::StrJoin(names, ", ")}));
    }
  }
  report.date_utc = DateUtc();
  report.cpu = CpuModel();
  report.load_average_start = LoadAverage();
  Runner runner(options, progress, report);
  for (const Item& item : runner.Items()) {
    if (std::find(options.cases.begin(), options.cases.end(), item.name) == options.cases.end()) {
      continue;
    }
    FP_RETURN_IF_ERROR(Annotate(runner.Run(item), item.name));
  }
  report.load_average_end = LoadAverage();
  return report;
}

}  // namespace farpoint
