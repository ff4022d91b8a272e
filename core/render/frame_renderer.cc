#include "core/render/frame_renderer.h"

#include <x86intrin.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <mutex>
#include <numeric>
#include <optional>
#include <utility>

#include "core/base/clock.h"
#include "core/base/pulse.h"
#include "core/irrcache/irradiance_cache.h"
#include "core/math/sampling.h"
#include "core/pbgi/cut_drawer.h"
#include "core/pbgi/microbuffer.h"
#include "core/pbgi/microbuffer_map.h"
#include "core/pbgi/receiver_cluster.h"
#include "core/pbgi/receiver_hierarchy.h"
#include "core/pbgi/tree_cut.h"
#include "core/render/ambient_occlusion.h"
#include "core/render/camera_rays.h"
#include "core/render/glossy_convolution.h"
#include "core/render/glossy_gatherer.h"
#include "core/render/glossy_path_tracer.h"
#include "core/render/glossy_point.h"
#include "core/render/loaded_scene.h"
#include "core/render/path_tracer.h"
#include "core/render/pixel_filter.h"
#include "core/render/record_gatherer.h"

namespace farpoint {

namespace {

// Samples that records serve with less weight than this get their own.
constexpr float kServed = 0.02f;

// Standard deviation among the records at a receiver that asks for one more, in parts of the
// frame's mean irradiance. Records of a draft disagree by their noise already.
constexpr float kMostSpread = 0.15f, kMostDraftSpread = 0.4f;
// The same of the sky's light, in parts of it and the indirect light: shadows have edges.
constexpr float kMostOpenSpread = 0.05f;
// The same of what is unhidden, in parts of its mean, where records are made for nothing else.
constexpr float kMostUnhiddenSpread = 0.05f;

// Keys of independent random choices.
enum : uint64_t { kKeyDirect = 2, kKeyPath = 3, kKeyCluster = 4, kKeyGloss = 5, kKeyOcclusion = 6 };

// Thread-seconds by stage. A stage is measured in clock ticks, which are cheap to read thousands
// of times; the sum is scaled to the block's processor time at the end.
class StageClock {
 public:
  StageClock() : cpu_(ThreadCpuSeconds()), start_(__rdtsc()), last_(start_) {}
  // What ran since the last call belongs to `stage`.
  void Charge(Stage stage) {
    const uint64_t now = __rdtsc();
    ticks_[static_cast<int>(stage)] += now - last_;
    last_ = now;
  }
  // What ran since the last call is measured by somebody else.
  void Skip() { last_ = __rdtsc(); }
  void Finish(Stats& stats) {
    const double total = static_cast<double>(std::max<uint64_t>(1, last_ - start_));
    const double cpu = ThreadCpuSeconds() - cpu_;
    for (int i = 0; i < kStageCount; ++i) {
      stats.seconds[i] += cpu * static_cast<double>(ticks_[i]) / total;
    }
  }

 private:
  double cpu_;
  uint64_t start_, last_;
  uint64_t ticks_[kStageCount] = {};
};

struct Counters {
  uint64_t receivers = 0, clusters = 0, cut_nodes = 0, rays = 0, node_visits = 0, splats = 0;
  uint64_t exact_discs = 0, own_records = 0, sample_records = 0;
  uint64_t skipped_no_receivers = 0, skipped_black = 0, skipped_unlit = 0, skipped_shadow = 0;
  uint64_t skipped_horizon = 0, skipped_invisible = 0, skipped_hidden = 0;
  uint64_t skipped_hidden_nodes = 0, skipped_hidden_subtrees = 0;
  uint64_t skipped_environments = 0, skipped_black_hits = 0;
  uint64_t glossy_receivers = 0, lobes_convolved = 0, skipped_matte = 0;
};

// One image sample: where the primary ray went.
struct Sample {
  bool hit = false;
  Rgb albedo, emission;
  float depth = std::numeric_limits<float>::infinity();
  uint32_t receiver = ~0u;  // index among the block's receivers
  Rgb direct_e, indirect_e, standard_error;
  float cluster = -1, cut_size = 0;
  float weight = 0, heaviest = 0;  // of the records that serve it, adaptive clusters
  float openness = 0;              // as they blend it, if the sky's light comes from them
  // Of glossy receivers: their index in Primary::glossy, what the diffuse base reflects of
  // irradiance, and radiance, W/(m² sr), in place of albedo E / pi.
  int32_t glossy = -1;
  Rgb diffuse_albedo, direct_l, diffuse_l, glossy_l;
  float unhidden = 0;  // ∫ V cosθ dω of the ambient occlusion, if it is asked for
};

// A block's samples, and what they hit.
struct Primary {
  std::vector<Sample> samples;
  std::vector<Receiver> receivers;
  std::vector<uint32_t> sample_of;  // of each receiver
  std::vector<uint8_t> wanted;      // by receiver: its pixel lies in the tile
  std::vector<GlossyPoint> glossy;  // by Sample::glossy
};

// Tiles of more samples than this do not keep what their primary rays hit while records are made.
constexpr int64_t kMostSamplesKept = 1 << 18;

// The parameters of adaptive clusters, measured in docs/decisions/0015-adaptive-clusters.md and
// 0024-faster-gather.md.
HierarchyParams HierarchyOf(const RenderSettings& settings) {
  HierarchyParams p;
  p.seed = settings.seed;
  switch (settings.quality) {
    case Quality::kDraft:
      p.coarsest_samples = 512;
      p.reach = 0.35f;
      p.enough = 0.05f;
      break;
    case Quality::kNormal:
      break;
    case Quality::kFine:
      p.coarsest_samples = 2048;
      p.fall_off = 0.25f;
      p.reach = 0.15f;
      p.enough = 0.25f;
      p.floor_px = 1;
      break;
  }
  return p;
}

// Standard deviation that a stratum of a record may leave, in parts of the frame's mean irradiance.
float NoiseOf(const RenderSettings& settings) {
  switch (settings.quality) {
    case Quality::kDraft:
      return 0.02f;
    case Quality::kNormal:
      break;
    case Quality::kFine:
      return 0.002f;
  }
  return 0.004f;
}

IrradianceCacheParams CacheOf(const RenderSettings& settings) {
  IrradianceCacheParams p;
  p.seed = settings.seed;
  p.error = settings.cache_error_in_force();
  // A finer cache is finer in corners too.
  p.least_px = std::clamp(12 * p.error, 1.0f, 6.0f);
  p.samples = settings.cache_samples_in_force();
  return p;
}

class Renderer final : public FrameRenderer {
 public:
  Renderer(std::shared_ptr<const LoadedScene> scene, const FrameSpec& frame)
      : holder_(std::move(scene)),
        scene_(static_cast<const LoadedSceneData&>(*holder_)),
        frame_(frame),
        settings_(frame.settings),
        rays_(frame.camera, frame.film, scene_.scene->origin()),
        map_(settings_.buffer_map, settings_.microbuffer_px()),
        filter_(settings_.filter, settings_.filter_width()),
        ray_grid_(HierarchyOf(settings_).coarsest_samples) {
    cut_params_.skip_below_horizon = settings_.skips(kSkipBelowHorizon);
    cut_params_.skip_invisible_side = settings_.skips(kSkipInvisibleSide);
    cut_params_.epsilon = settings_.epsilon;
    cut_params_.map = settings_.buffer_map;
    cut_params_.pixel_sr = map_.reference_solid_angle();
    const auto wants = [&](Layer layer) {
      return std::find(settings_.layers.begin(), settings_.layers.end(), layer) !=
             settings_.layers.end();
    };
    wants_irradiance_ =
        wants(Layer::kIrradiance) || wants(Layer::kStdError) || wants(Layer::kCutSize);
    wants_direct_irradiance_ = wants(Layer::kDirectIrradiance);
    wants_cluster_ = wants(Layer::kCluster) || wants(Layer::kCutSize);
    // Who asks for the size of cuts asks for that of whole ones.
    hide_ = settings_.skips(kSkipHidden) && !wants(Layer::kCutSize);
    wants_indirect_ = wants_irradiance_ || wants(Layer::kDiffuseIndirect) ||
                      wants(Layer::kGlossyIndirect) || wants(Layer::kIndirect) ||
                      wants(Layer::kBeauty) || wants(Layer::kCluster);
    wants_direct_ = wants_direct_irradiance_ || wants(Layer::kDirect) || wants(Layer::kBeauty);
    // Records see how much of a constant sky is open with the rays that they trace anyway, many
    // more than a receiver has shadow rays. Also where nobody asks for direct light: what records
    // are must not depend on the layers.
    sky_by_records_ = settings_.adaptive() && settings_.fill_in_force() == Fill::kRays &&
                      !scene_.scene->has_environment_map() &&
                      MaxComponent(scene_.scene->sky()) > 0.0f && scene_.tree != nullptr &&
                      scene_.tree->lit();
    if (scene_.scene->has_gloss()) glossy_ = std::make_unique<GlossyGatherer>(scene_, settings_);
    // Where nobody asks for light, or there is none, records are made for ambient occlusion alone.
    wants_occlusion_ = wants(Layer::kAmbientOcclusion);
    if (wants_occlusion_) {
      ao_distance_m_ = AoDistance(settings_, *scene_.scene);
      const bool lit = settings_.point_based() ? scene_.tree != nullptr && scene_.tree->lit()
                                               : scene_.lights->any_light();
      occlusion_alone_ = !lit || !WantsGather();
      if (occlusion_alone_) sky_by_records_ = false;
    }
    if (settings_.integrator == Integrator::kFpbgi ||
        settings_.integrator == Integrator::kIrrcache) {
      gatherer_ =
          std::make_unique<RecordGatherer>(scene_, rays_, settings_, map_, cut_params_,
                                           sky_by_records_, ao_distance_m_, !occlusion_alone_);
    }
  }

  absl::StatusOr<TileOutput> RenderTile(const PixelRect& tile, Executor& executor,
                                        const std::function<void(int, int)>& progress,
                                        const std::atomic<bool>* cancel) const override {
    if (tile.empty() || !frame_.film.crop.Contains(tile)) {
      return absl::InvalidArgumentError("the tile lies outside the frame's crop");
    }
    const auto wall_start = std::chrono::steady_clock::now();
    TileOutput out;
    out.film = Film(tile, settings_.layers);
    const std::vector<PixelRect> blocks = BlocksOf(tile, frame_.film.frame());
    std::vector<Stats> block_stats(blocks.size());
    std::atomic<bool> finite{true}, cancelled{false};
    std::mutex progress_mutex;
    int done = 0;
    const bool in_two_halves = settings_.adaptive() || NeedsCache();
    const int total = static_cast<int>(blocks.size()) * (in_two_halves ? 2 : 1);
    int reported = 0;
    const auto go_on = [&](double part) {
      if (progress) {
        const std::lock_guard lock(progress_mutex);
        const int now = static_cast<int>(part * static_cast<double>(blocks.size()));
        if (now > reported) progress(reported = now, total);
      }
      return cancel == nullptr || !cancel->load(std::memory_order_relaxed);
    };
    std::vector<std::optional<Primary>> primary(blocks.size());
    std::shared_ptr<const ReceiverHierarchy::View> view;
    bool gathers = true;
    PixelRect gathered = tile;
    if (NeedsHierarchy() && settings_.skips(kSkipIdleBlocks) &&
        tile.area() * int64_t{settings_.spp} <= kMostSamplesKept) {
      executor.ForEach(blocks.size(), 1, [&](size_t i) {
        primary[i].emplace();
        TracePrimary(blocks[i], tile, *primary[i], block_stats[i]);
      });
      gathered = WhereLightIsGathered(blocks, tile, primary);
      gathers = !gathered.empty();
      uint64_t idle = 0;
      for (const PixelRect& block : blocks) idle += gathered.Intersect(block).empty();
      out.stats.skipped["blocks_without_gather"] += idle;
    }
    if (NeedsHierarchy() && gathers) {
      const double cpu = ProcessCpuSeconds();
      ReceiverHierarchy::Counts counts;
      std::call_once(scaled_, [&] {
        const RecordGatherer::Means mean = gatherer_->MeanOf(frame_.film.frame(), executor);
        HierarchyParams params = HierarchyOf(settings_);
        const bool draft = settings_.quality == Quality::kDraft;
        params.spread_wm2 = (draft ? kMostDraftSpread : kMostSpread) * mean.irradiance;
        const float noise = NoiseOf(settings_);
        RecordGatherer::Means deviation{noise * mean.irradiance, 0};
        if (sky_by_records_) {
          // The openness that the sky would need to bring the frame's mean light.
          const Rgb& sky = scene_.scene->sky();
          const float all = mean.openness + 3 * mean.irradiance / (sky.x + sky.y + sky.z);
          params.spread_open = kMostOpenSpread * all;
          deviation.openness = noise * all;
        }
        if (occlusion_alone_) {
          params.spread_open = kMostUnhiddenSpread * mean.openness;
          deviation.openness = noise * mean.openness;
        }
        hierarchy_ = std::make_unique<ReceiverHierarchy>(params, frame_.film.frame(), *gatherer_);
        gatherer_->Refine(deviation, hierarchy_->finest_strata());
      });
      view = hierarchy_->Prepare(gathered, executor, go_on, counts);
      Stats stats = gatherer_->TakeStats();
      if (!view) return absl::CancelledError("the tile was cancelled");
      // What is not gathering is choosing.
      double gathering = 0;
      for (const double s : stats.seconds) gathering += s;
      stats.seconds[static_cast<int>(Stage::kCluster)] +=
          std::max(0.0, ProcessCpuSeconds() - cpu - gathering);
      stats.counts["clusters"] += counts.records;
      stats.counts["cluster_candidates"] += counts.candidates;
      stats.counts["cluster_samples"] += counts.samples;
      // Places that others serve well enough.
      stats.skipped["clusters"] += counts.candidates - std::min(counts.candidates, counts.records);
      out.stats += stats;
    }
    const IrradianceCache* cache = nullptr;
    if (NeedsCache()) {
      cache = Cache(executor, go_on, out.stats);
      if (cache == nullptr) return absl::CancelledError("the tile was cancelled");
    }
    if (in_two_halves) done = static_cast<int>(blocks.size());
    executor.ForEach(blocks.size(), 1, [&](size_t i) {
      if (cancel != nullptr && cancel->load(std::memory_order_relaxed)) {
        cancelled = true;
        return;
      }
      if (!primary[i]) {
        primary[i].emplace();
        TracePrimary(blocks[i], tile, *primary[i], block_stats[i]);
      }
      if (!RenderBlock(blocks[i], tile, *primary[i], gathers, view.get(), cache, out.film,
                       block_stats[i])) {
        finite = false;
      }
      primary[i].reset();
      if (progress) {
        const std::lock_guard lock(progress_mutex);
        progress(++done, total);
      }
    });
    if (cancelled) return absl::CancelledError("the tile was cancelled");
    if (!finite) {
      return absl::InternalError("tile at " + std::to_string(tile.x0) + "," +
                                 std::to_string(tile.y0) +
                                 ": a pixel is not finite; this is a defect of farpoint");
    }
    for (const Stats& s : block_stats) out.stats += s;
    const double wall =
        std::chrono::duration<double>(std::chrono::steady_clock::now() - wall_start).count();
    double sum = 0;
    for (const double s : out.stats.seconds) sum += s;
    for (int i = 0; i < kStageCount && sum > 0; ++i) {
      out.stats.wall_seconds[i] = wall * out.stats.seconds[i] / sum;
    }
    out.film.RoundToStorage();
    return out;
  }

 private:
  // What the camera sees of a block. The samples to be computed are those of pixels inside the
  // tile; clusters are made of all receivers of the block, so that a tile or a crop changes
  // nothing.
  void TracePrimary(const PixelRect& block, const PixelRect& tile, Primary& out,
                    Stats& stats) const {
    StageClock clock;
    Counters n;
    const uint32_t spp = settings_.spp;
    out.samples.resize(static_cast<size_t>(block.area()) * spp);
    TracePrimary(block, out, n);
    const PixelRect inside = block.Intersect(tile);
    out.wanted.resize(out.receivers.size());
    for (size_t r = 0; r < out.receivers.size(); ++r) {
      const int64_t pixel = out.sample_of[r] / spp;
      out.wanted[r] = inside.Contains(block.x0 + static_cast<int>(pixel % block.width()),
                                      block.y0 + static_cast<int>(pixel / block.width()));
      n.receivers += out.wanted[r];
    }
    if (out.receivers.empty()) n.skipped_no_receivers = 1;
    clock.Charge(Stage::kPrimary);
    clock.Finish(stats);
    Report(n, stats);
  }

  // A receiver whose albedo is black shows no indirect light; it is gathered only if its irradiance
  // or its cluster itself was asked for.
  bool GathersBlack() const {
    return wants_irradiance_ || wants_cluster_ || wants_occlusion_ ||
           (sky_by_records_ && wants_direct_irradiance_);
  }
  static bool IsBlack(const Sample& sample) {
    return !(MaxComponent(sample.glossy < 0 ? sample.albedo : sample.diffuse_albedo) > 0.0f);
  }

  // The part of the tile that holds all blocks with receivers that gather.
  PixelRect WhereLightIsGathered(std::span<const PixelRect> blocks, const PixelRect& tile,
                                 std::span<const std::optional<Primary>> primary) const {
    const bool gathers_black = GathersBlack() || !settings_.skips(kSkipBlack);
    PixelRect all{tile.x1, tile.y1, tile.x0, tile.y0};
    for (size_t i = 0; i < blocks.size(); ++i) {
      const Primary& p = *primary[i];
      bool any = false;
      for (size_t r = 0; r < p.receivers.size() && !any; ++r) {
        any = p.wanted[r] != 0 && (gathers_black || !IsBlack(p.samples[p.sample_of[r]]));
      }
      if (!any) continue;
      const PixelRect part = blocks[i].Intersect(tile);
      all = {std::min(all.x0, part.x0), std::min(all.y0, part.y0), std::max(all.x1, part.x1),
             std::max(all.y1, part.y1)};
    }
    return all.x0 < all.x1 ? all : PixelRect{tile.x0, tile.y0, tile.x0, tile.y0};
  }

  // `gathers`: false: adaptive clusters have nothing to serve. False if a value is not finite.
  bool RenderBlock(const PixelRect& block, const PixelRect& tile, Primary& primary, bool gathers,
                   const ReceiverHierarchy::View* view, const IrradianceCache* cache, Film& film,
                   Stats& stats) const {
    StageClock clock;
    Counters n;
    const PixelRect inside = block.Intersect(tile);
    auto& [samples, receivers, sample_of, wanted, glossy] = primary;
    if (wants_direct_ && scene_.lights->any_light()) {
      Direct(block, samples, receivers, sample_of, wanted, n);
    }
    clock.Charge(Stage::kDirect);
    if (glossy_ != nullptr && (wants_direct_ || wants_indirect_)) {
      ReflectGloss(block, primary, n, stats);
      clock.Charge(Stage::kTrace);
    }

    if ((WantsGather() || wants_occlusion_) && !receivers.empty()) {
      if (!GathersBlack() && settings_.skips(kSkipBlack)) {
        for (size_t r = 0; r < receivers.size(); ++r) {
          const Sample& sample = samples[sample_of[r]];
          const bool has_more =
              sample.glossy >= 0 && (settings_.integrator == Integrator::kPt ||
                                     ByBuffer(glossy[static_cast<size_t>(sample.glossy)]));
          if (wanted[r] && IsBlack(sample) && !has_more) {
            wanted[r] = 0;
            ++n.skipped_black;
          }
        }
      }
      if (settings_.integrator == Integrator::kPt) {
        if (WantsGather()) TracePaths(block, primary, n);
        if (wants_occlusion_) TraceOcclusion(block, samples, receivers, sample_of, wanted, n);
        clock.Charge(Stage::kTrace);
      } else if (settings_.integrator == Integrator::kIrrcache) {
        if (cache != nullptr) {
          Interpolate(*cache, block, samples, receivers, sample_of, wanted, n, stats, clock);
        } else {
          n.skipped_unlit += receivers.size();
        }
        clock.Charge(Stage::kConvolve);
      } else if (view != nullptr) {
        Blend(*view, block, samples, receivers, sample_of, wanted, n, stats, clock);
        clock.Charge(Stage::kConvolve);
      } else if (gathers) {
        Gather(block, primary, n, clock);
        if (gatherer_) stats += gatherer_->TakeStats();
      }
    }

    if (settings_.integrator != Integrator::kPt) {
      for (Sample& sample : samples) {
        if (sample.glossy < 0) continue;
        sample.diffuse_l = sample.diffuse_albedo * sample.indirect_e * kInvPif;
      }
    }
    const bool finite = Develop(block, inside, samples, receivers, film);
    clock.Charge(Stage::kConvolve);
    clock.Finish(stats);
    Report(n, stats);
    stats.counts["blocks"] += 1;
    return finite;
  }

  void TracePrimary(const PixelRect& block, Primary& out, Counters& n) const {
    const PreparedScene& scene = *scene_.scene;
    auto& [samples, receivers, sample_of, wanted, glossy] = out;
    size_t at = 0;
    for (int y = block.y0; y < block.y1; ++y) {
      for (int x = block.x0; x < block.x1; ++x) {
        for (uint32_t s = 0; s < settings_.spp; ++s, ++at) {
          const Vec2f offset = SamplePosition(filter_, settings_.seed, settings_.spp, x, y, s);
          const Vec3f w =
              rays_.Direction(x + static_cast<double>(offset.x), y + static_cast<double>(offset.y));
          ++n.rays;
          const std::optional<RayHit> hit = FirstSeen(*scene_.accel, rays_.eye(), w);
          Sample& sample = samples[at];
          if (!hit) {
            sample.emission = scene.EnvironmentRadiance(w);
            continue;
          }
          const SurfaceSample surface = scene.Surface(hit->triangle, hit->b1, hit->b2);
          sample.hit = true;
          sample.albedo = surface.albedo;
          sample.emission = surface.emission;
          sample.receiver = static_cast<uint32_t>(receivers.size());
          const Receiver r = ReceiverOfHit(*scene_.accel, *hit, w);
          sample.depth = rays_.Depth(r.position);
          if (glossy_ != nullptr && scene.IsGlossy(hit->triangle)) {
            sample.glossy = static_cast<int32_t>(glossy.size());
            glossy.emplace_back(*scene_.accel, *hit, w);
            sample.diffuse_albedo = glossy.back().brdf().diffuse_albedo();
          }
          receivers.push_back(r);
          sample_of.push_back(static_cast<uint32_t>(at));
        }
        Pulse();
      }
    }
  }

  uint64_t PixelKey(const PixelRect& block, uint32_t sample, uint64_t purpose) const {
    const uint64_t pixel = sample / settings_.spp;
    return HashKey(settings_.seed, purpose,
                   static_cast<uint64_t>(block.x0) + pixel % static_cast<uint64_t>(block.width()),
                   static_cast<uint64_t>(block.y0) + pixel / static_cast<uint64_t>(block.width()));
  }

  void Direct(const PixelRect& block, std::vector<Sample>& samples,
              const std::vector<Receiver>& receivers, const std::vector<uint32_t>& sample_of,
              const std::vector<uint8_t>& wanted, Counters& n) const {
    // The samples of a pixel share its shadow rays out among them: one stratified set.
    const uint32_t each = (settings_.light_samples + settings_.spp - 1) / settings_.spp;
    LightCounters counters;
    for (size_t r = 0; r < receivers.size(); ++r) {
      Pulse();
      if (!wanted[r]) continue;
      Sample& sample = samples[sample_of[r]];
      if (sample.glossy >= 0 && !wants_direct_irradiance_) continue;
      if (IsBlack(sample) && !wants_direct_irradiance_ && settings_.skips(kSkipBlack)) {
        ++n.skipped_black;
        continue;
      }
      sample.direct_e = scene_.lights->Irradiance(
          receivers[r].surface(), each, PixelKey(block, sample_of[r], kKeyDirect),
          (sample_of[r] % settings_.spp) * each, 0, counters, LightSampler::kOfReceivers,
          !sky_by_records_, NeedlessLightOf(settings_));
    }
    Add(counters, n);
  }

  // Glossy receivers: all their direct light, and, but for the path tracer, what their interface
  // reflects of indirect light.
  void ReflectGloss(const PixelRect& block, Primary& primary, Counters& n, Stats& stats) const {
    auto& [samples, receivers, sample_of, wanted, glossy] = primary;
    if (!scene_.lights->any_light()) return;
    const uint32_t each = (settings_.light_samples + settings_.spp - 1) / settings_.spp;
    const bool by_rays = wants_indirect_ && settings_.integrator != Integrator::kPt;
    LightCounters counters;
    for (size_t r = 0; r < receivers.size(); ++r) {
      Pulse();
      if (!wanted[r]) continue;
      Sample& sample = samples[sample_of[r]];
      if (sample.glossy < 0) {
        ++n.skipped_matte;
        continue;
      }
      ++n.glossy_receivers;
      const GlossyGatherer::Reflected reflected = glossy_->Reflect(
          receivers[r], glossy[static_cast<size_t>(sample.glossy)],
          HashKey(PixelKey(block, sample_of[r], kKeyGloss), sample_of[r] % settings_.spp), each,
          wants_direct_, by_rays && !ByBuffer(glossy[static_cast<size_t>(sample.glossy)]), counters,
          stats);
      sample.direct_l = reflected.direct;
      sample.glossy_l = reflected.indirect;
    }
    Add(counters, n);
  }

  void TracePaths(const PixelRect& block, Primary& primary, Counters& n) const {
    auto& [samples, receivers, sample_of, wanted, glossy] = primary;
    if (!scene_.lights->any_light() && settings_.skips(kSkipUnlit)) {
      n.skipped_unlit += receivers.size();
      return;
    }
    LightCounters counters;
    for (size_t r = 0; r < receivers.size(); ++r) {
      Pulse();
      if (!wanted[r]) continue;
      Sample& sample = samples[sample_of[r]];
      const uint64_t key =
          HashKey(PixelKey(block, sample_of[r], kKeyPath), sample_of[r] % settings_.spp);
      if (glossy_ != nullptr) {
        if (sample.glossy >= 0) {
          const TracedReflection traced = TraceGlossyIndirect(
              *scene_.accel, *scene_.lights, glossy[static_cast<size_t>(sample.glossy)],
              settings_.paths, settings_.bounces, HashKey(key, kKeyGloss), counters, n.rays,
              NeedlessLightOf(settings_));
          sample.diffuse_l = traced.diffuse;
          sample.glossy_l = traced.glossy;
          if (!wants_irradiance_) continue;
        }
        const TracedIrradiance traced = TraceIndirectAmongGloss(
            *scene_.accel, *scene_.lights, receivers[r], settings_.paths, settings_.bounces, key,
            counters, n.rays, NeedlessLightOf(settings_));
        sample.indirect_e = traced.irradiance;
        sample.standard_error = traced.standard_error;
        continue;
      }
      const TracedIrradiance traced = TraceIndirect(
          *scene_.accel, *scene_.lights, receivers[r], settings_.paths, settings_.bounces, key,
          counters, n.rays, NeedlessLightOf(settings_), !settings_.skips(kSkipBlack));
      sample.indirect_e = traced.irradiance;
      sample.standard_error = traced.standard_error;
    }
    Add(counters, n);
  }

  void TraceOcclusion(const PixelRect& block, std::vector<Sample>& samples,
                      const std::vector<Receiver>& receivers,
                      const std::vector<uint32_t>& sample_of, const std::vector<uint8_t>& wanted,
                      Counters& n) const {
    for (size_t r = 0; r < receivers.size(); ++r) {
      Pulse();
      if (!wanted[r]) continue;
      samples[sample_of[r]].unhidden =
          kPif * TraceAmbientOcclusion(*scene_.accel, receivers[r], ao_distance_m_, settings_.paths,
                                       HashKey(PixelKey(block, sample_of[r], kKeyOcclusion),
                                               sample_of[r] % settings_.spp),
                                       n.rays);
    }
  }

  static void Add(const LightCounters& counters, Counters& n) {
    n.rays += counters.rays + counters.needless;
    n.skipped_shadow += counters.skipped_facing_away;
    n.skipped_environments += counters.skipped_environments;
    n.skipped_black_hits += counters.skipped_black;
  }

  // Records may bring direct light, too.
  bool WantsGather() const { return wants_indirect_ || (wants_direct_ && sky_by_records_); }

  // Without light there is nothing to gather.
  bool NeedsHierarchy() const {
    if (!settings_.adaptive()) return false;
    if (wants_occlusion_) return true;
    return WantsGather() &&
           (!settings_.skips(kSkipUnlit) || (scene_.tree != nullptr && scene_.tree->lit()));
  }

  // Without light there is nothing to cache.
  bool NeedsCache() const {
    if (settings_.integrator != Integrator::kIrrcache) return false;
    if (wants_occlusion_) return true;
    return wants_indirect_ && (!settings_.skips(kSkipUnlit) || scene_.lights->any_light());
  }

  // The cache of the whole frame, made by the first tile that asks; others wait for it. Null:
  // `go_on` said no, and the next one begins again.
  const IrradianceCache* Cache(Executor& executor, const std::function<bool(double)>& go_on,
                               Stats& stats) const {
    const std::lock_guard lock(cache_mutex_);
    if (cache_) return cache_.get();
    const double cpu = ProcessCpuSeconds();
    IrradianceCache::Counts counts;
    cache_ = IrradianceCache::Build(CacheOf(settings_), frame_.film.frame(), scene_.scene->bounds(),
                                    rays_.eye(), *gatherer_, executor, go_on, counts);
    Stats gathers = gatherer_->TakeStats();
    double gathering = 0;
    for (const double s : gathers.seconds) gathering += s;
    gathers.seconds[static_cast<int>(Stage::kCluster)] +=
        std::max(0.0, ProcessCpuSeconds() - cpu - gathering);
    gathers.counts["cache_candidates"] += counts.candidates;
    gathers.counts["cache_records"] += counts.records;
    gathers.counts["cache_samples"] += counts.samples;
    stats += gathers;
    return cache_.get();
  }

  // The irradiance cache: receivers interpolate its records; where none weighs they get their own,
  // which samples of a pixel share.
  void Interpolate(const IrradianceCache& cache, const PixelRect& block,
                   std::vector<Sample>& samples, const std::vector<Receiver>& receivers,
                   const std::vector<uint32_t>& sample_of, const std::vector<uint8_t>& wanted,
                   Counters& n, Stats& stats, StageClock& clock) const {
    std::vector<GatherRecord> own;
    uint32_t last_pixel = ~0u;
    for (const uint32_t r : BlackLast(samples, sample_of)) {
      Pulse();
      if (std::exchange(last_pixel, sample_of[r] / settings_.spp) != last_pixel) own.clear();
      if (!wanted[r]) continue;
      Sample& sample = samples[sample_of[r]];
      const Receiver& receiver = receivers[r];
      CachedIrradiance e = cache.Interpolate(receiver.position, receiver.normal);
      if (!(e.weight >= kServed)) {
        e = InterpolateAll(own, receiver.position, receiver.normal);
        if (!(e.weight >= cache.params().enough)) {
          clock.Charge(Stage::kConvolve);
          own.push_back(cache.MakeOwnRecord(
              receiver, rays_.FootprintAt(receiver.position),
              HashKey(PixelKey(block, sample_of[r], kKeyCluster), sample_of[r] % settings_.spp)));
          clock.Skip();
          e.irradiance = own.back().irradiance;
          e.unhidden = own.back().unhidden;
          ++n.own_records;
        }
      }
      sample.indirect_e = e.irradiance;
      sample.unhidden = e.unhidden;
    }
    stats += gatherer_->TakeStats();
  }

  // The receivers by pixel, within a pixel those whose albedo is black last: whether they are
  // gathered depends on what was asked for, so the others must not read what was made for them.
  std::vector<uint32_t> BlackLast(const std::vector<Sample>& samples,
                                  const std::vector<uint32_t>& sample_of) const {
    std::vector<uint32_t> order(sample_of.size());
    std::iota(order.begin(), order.end(), 0u);
    for (size_t begin = 0, end; begin < order.size(); begin = end) {
      for (end = begin; end < order.size() &&
                        sample_of[end] / settings_.spp == sample_of[begin] / settings_.spp;) {
        ++end;
      }
      std::stable_partition(order.begin() + static_cast<ptrdiff_t>(begin),
                            order.begin() + static_cast<ptrdiff_t>(end),
                            [&](uint32_t r) { return !IsBlack(samples[sample_of[r]]); });
    }
    return order;
  }

  // Of the pixel of a record's place, or the nearest within the frame.
  float PixelIndex(float x_px, float y_px) const {
    const int x = std::clamp(static_cast<int>(x_px), 0, frame_.film.width - 1);
    const int y = std::clamp(static_cast<int>(y_px), 0, frame_.film.height - 1);
    return static_cast<float>(y) * static_cast<float>(frame_.film.width) + static_cast<float>(x);
  }

  // Adaptive clusters: receivers blend the records about them.
  void Blend(const ReceiverHierarchy::View& view, const PixelRect& block,
             std::vector<Sample>& samples, const std::vector<Receiver>& receivers,
             const std::vector<uint32_t>& sample_of, const std::vector<uint8_t>& wanted,
             Counters& n, Stats& stats, StageClock& clock) const {
    constexpr int kSide = 8;
    constexpr int kAcross = kBlockSize / kSide;
    const uint32_t spp = settings_.spp;
    std::array<std::vector<uint32_t>, kAcross * kAcross> groups;
    for (uint32_t r = 0; r < receivers.size(); ++r) {
      if (!wanted[r]) continue;
      const int pixel = static_cast<int>(sample_of[r] / spp);
      groups[static_cast<size_t>(pixel / block.width() / kSide * kAcross +
                                 pixel % block.width() / kSide)]
          .push_back(r);
    }
    std::vector<const ScreenRecord*> records;
    std::vector<std::array<float, 8>> shares;  // of the records, if they are asked for
    for (size_t g = 0; g < groups.size(); ++g) {
      if (groups[g].empty()) continue;
      const int x0 = block.x0 + static_cast<int>(g) % kAcross * kSide;
      const int y0 = block.y0 + static_cast<int>(g) / kAcross * kSide;
      records.clear();
      view.Collect({x0, y0, x0 + kSide, y0 + kSide}, records);
      for (size_t at = 0; at < groups[g].size(); at += 8) {
        Pulse();
        const size_t count = std::min<size_t>(8, groups[g].size() - at);
        ServedReceiver served[8];
        Rgb e[8];
        float weight[8], openness[8], unhidden[8];
        for (size_t i = 0; i < count; ++i) {
          const uint32_t r = groups[g][at + i];
          const int pixel = static_cast<int>(sample_of[r] / spp);
          served[i] = {&receivers[r], static_cast<float>(block.x0 + pixel % block.width()) + 0.5f,
                       static_cast<float>(block.y0 + pixel / block.width()) + 0.5f};
        }
        if (wants_cluster_) shares.resize(records.size());
        BlendRecords(records, {served, count}, {e, count}, {weight, count}, {}, shares,
                     {openness, sky_by_records_ ? count : 0},
                     {unhidden, wants_occlusion_ ? count : 0});
        for (size_t i = 0; i < count; ++i) {
          Sample& sample = samples[sample_of[groups[g][at + i]]];
          sample.indirect_e = e[i];
          sample.weight = weight[i];
          if (sky_by_records_) sample.openness = openness[i];
          if (wants_occlusion_) sample.unhidden = unhidden[i];
          if (!wants_cluster_) continue;
          for (size_t k = 0; k < records.size(); ++k) {
            const float share = shares[k][i];
            if (!(share > 0.0f)) continue;
            ++sample.cut_size;
            if (share > sample.heaviest) {
              sample.heaviest = share;
              sample.cluster = PixelIndex(records[k]->x_px, records[k]->y_px);
            }
          }
        }
      }
    }
    if (spp > 1) MakeOwnRecords(block, samples, receivers, sample_of, wanted, n, clock);
    if (sky_by_records_) {
      for (uint32_t r = 0; r < receivers.size(); ++r) {
        Sample& sample = samples[sample_of[r]];
        if (wanted[r]) sample.direct_e += scene_.scene->sky() * sample.openness;
      }
    }
    stats += gatherer_->TakeStats();
  }

  // Samples beside a pixel's centre may lie on a surface that no candidate saw. Those of a pixel
  // share what they make.
  void MakeOwnRecords(const PixelRect& block, std::vector<Sample>& samples,
                      const std::vector<Receiver>& receivers,
                      const std::vector<uint32_t>& sample_of, const std::vector<uint8_t>& wanted,
                      Counters& n, StageClock& clock) const {
    const uint32_t spp = settings_.spp;
    const auto lacks = [&](uint32_t r) {
      return wanted[r] != 0 && !(samples[sample_of[r]].weight >= kServed);
    };
    const std::vector<uint32_t> order = BlackLast(samples, sample_of);
    std::vector<ScreenRecord> own;
    std::vector<const ScreenRecord*> own_list;
    for (size_t begin = 0, end; begin < order.size(); begin = end) {
      // The samples of a pixel that are alike black or not, and how many of them lack records:
      // those that are not black must not know of the others.
      const uint32_t pixel = sample_of[order[begin]] / spp;
      const bool black = IsBlack(samples[sample_of[order[begin]]]);
      uint32_t left = 0;
      for (end = begin; end < order.size() && sample_of[order[end]] / spp == pixel &&
                        IsBlack(samples[sample_of[order[end]]]) == black;
           ++end) {
        left += lacks(order[end]);
      }
      if (begin == 0 || sample_of[order[begin - 1]] / spp != pixel) {
        own.clear();
        own.reserve(spp);
        own_list.clear();
      }
      if (left == 0) continue;
      const int x = block.x0 + static_cast<int>(pixel) % block.width();
      const int y = block.y0 + static_cast<int>(pixel) / block.width();
      for (size_t i = begin; i < end; ++i) {
        const uint32_t r = order[i];
        if (!lacks(r)) continue;
        const float share = static_cast<float>(left--) / static_cast<float>(spp);
        Sample& sample = samples[sample_of[r]];
        const ServedReceiver served{&receivers[r], static_cast<float>(x) + 0.5f,
                                    static_cast<float>(y) + 0.5f};
        BlendRecords(own_list, {&served, 1}, {&sample.indirect_e, 1}, {&sample.weight, 1}, {}, {},
                     {&sample.openness, size_t{sky_by_records_}},
                     {&sample.unhidden, size_t{wants_occlusion_}});
        if (sample.weight >= hierarchy_->params().enough) continue;
        clock.Charge(Stage::kConvolve);
        own.push_back(hierarchy_->MakeOwnRecord(
            served, rays_.FootprintAt(receivers[r].position),
            HashKey(static_cast<uint64_t>(x), static_cast<uint64_t>(y), sample_of[r] % spp),
            share));
        clock.Skip();
        own_list.push_back(&own.back());
        sample.indirect_e = own.back().gather.irradiance;
        if (sky_by_records_) sample.openness = own.back().gather.openness;
        if (wants_occlusion_) sample.unhidden = own.back().gather.unhidden;
        ++n.clusters;
        ++n.sample_records;
      }
    }
  }

  // Receivers that have a microbuffer read it where its pixels carry their lobe; else rays do.
  bool ByBuffer(const GlossyPoint& point) const {
    if (!settings_.point_based() || settings_.adaptive()) return false;
    const bool filled_by_rays =
        settings_.integrator == Integrator::kFpbgi && settings_.fill_in_force() == Fill::kRays;
    return !filled_by_rays && CarriesLobe(map_, point.brdf().alpha());
  }

  void Gather(const PixelRect& block, Primary& primary, Counters& n, StageClock& clock) const {
    auto& [samples, receivers, sample_of, wanted, glossy] = primary;
    const PointTree& tree = *scene_.tree;
    if (!tree.lit() && settings_.skips(kSkipUnlit) && !wants_occlusion_) {
      n.skipped_unlit += receivers.size();
      return;
    }
    std::vector<ReceiverCluster> clusters;
    if (settings_.integrator == Integrator::kFpbgi) {
      ClusterParams params;
      params.k = settings_.clusters;
      params.iterations = settings_.kmeans_iterations;
      params.normal_weight = settings_.normal_weight;
      params.seed_key =
          HashKey(settings_.seed, kKeyCluster, static_cast<uint64_t>(block.x0 / kBlockSize),
                  static_cast<uint64_t>(block.y0 / kBlockSize));
      clusters = ClusterReceivers(receivers, params);
      clock.Charge(Stage::kCluster);
    } else {
      // pbgi: every receiver is a cluster of its own.
      for (uint32_t r = 0; r < receivers.size(); ++r) {
        ReceiverCluster c;
        c.members = {r};
        c.active = r;
        c.mean_normal = receivers[r].normal;
        c.radius_m = c.sin_spread = c.margin_m = 0;
        c.cos_spread = 1;
        c.sees_inside = receivers[r].on_back;
        clusters.push_back(std::move(c));
      }
    }

    const bool by_rays =
        settings_.integrator == Integrator::kFpbgi && settings_.fill_in_force() == Fill::kRays;
    Microbuffer far_buffer(map_), near_buffer(map_);
    GlossyConvolution convolution(map_);
    CutDrawer drawer(tree, map_, cut_params_, settings_.splat, hide_);
    std::vector<CutNode> cut, scratch;
    std::vector<NearNode> near;
    PackedNearNodes packed;
    CutCounters cut_counters;
    RasterCounters raster_counters;
    HiddenCounters hidden_counters;
    for (size_t c = 0; c < clusters.size(); ++c) {
      Pulse();
      const ReceiverCluster& cluster = clusters[c];
      const bool any = std::any_of(cluster.members.begin(), cluster.members.end(),
                                   [&](uint32_t r) { return wanted[r] != 0; });
      if (!any) continue;
      ++n.clusters;
      if (by_rays) {
        clock.Charge(Stage::kConvolve);
        const GatherRecord record =
            gatherer_->Gather(receivers[cluster.active], ray_grid_,
                              HashKey(PixelKey(block, sample_of[cluster.active], kKeyCluster),
                                      sample_of[cluster.active] % settings_.spp));
        clock.Skip();
        for (const uint32_t r : cluster.members) {
          if (!wanted[r]) continue;
          Sample& sample = samples[sample_of[r]];
          sample.cluster = static_cast<float>(c);
          sample.indirect_e = IrradianceAt(record, receivers[r].position, receivers[r].normal);
          if (wants_occlusion_) {
            sample.unhidden = UnhiddenAt(record, receivers[r].position, receivers[r].normal);
          }
        }
        continue;
      }
      // Cluster cut and microbuffer (paper §3.2). Where there is nothing to share, all is far.
      const bool alone = cluster.members.size() == 1;
      CutView view;
      view.position = receivers[cluster.active].position;
      view.normal = cluster.mean_normal;
      view.radius_m = cluster.radius_m;
      view.sin_spread = cluster.sin_spread;
      view.cos_spread = cluster.cos_spread;
      view.margin_m = cluster.margin_m;
      view.sees_inside = cluster.sees_inside;
      near.clear();
      const size_t shared_nodes =
          drawer.Draw(view, alone ? nullptr : &near, far_buffer, cut_counters, raster_counters,
                      hidden_counters, [&](CutDrawer::Part part) {
                        clock.Charge(part == CutDrawer::Part::kCut ? Stage::kCut : Stage::kRaster);
                      });
      n.cut_nodes += shared_nodes + near.size();
      packed.Pack(tree, near);
      clock.Charge(Stage::kCut);

      // Receiver cuts and microbuffers, composite, convolution (§3.3).
      for (const uint32_t r : cluster.members) {
        if (!wanted[r]) continue;
        Sample& sample = samples[sample_of[r]];
        sample.cluster = static_cast<float>(c);
        const Microbuffer* own = nullptr;
        size_t own_nodes = 0;
        if (!near.empty()) {
          CutView receiver_view;
          receiver_view.position = receivers[r].position;
          receiver_view.normal = receivers[r].normal;
          receiver_view.sees_inside = receivers[r].on_back;
          cut.clear();
          ComputeReceiverCut(tree, receiver_view, cut_params_, packed, cut, cut_counters);
          own_nodes = cut.size();
          n.cut_nodes += cut.size();
          clock.Charge(Stage::kCut);
          if (!cut.empty()) {
            near_buffer.Clear();
            SortFrontToBack(cut, scratch);
            RasterizeCut(tree, receiver_view, cut, settings_.splat, near_buffer, raster_counters);
            if (!near_buffer.empty()) own = &near_buffer;
            clock.Charge(Stage::kRaster);
          }
        }
        sample.cut_size = static_cast<float>(alone ? shared_nodes : own_nodes);
        sample.indirect_e = ConvolveCosine(far_buffer, own, receivers[r].normal, settings_.splat);
        if (sample.glossy >= 0) {
          const GlossyPoint& point = glossy[static_cast<size_t>(sample.glossy)];
          if (ByBuffer(point)) {
            sample.glossy_l = convolution.Reflect(far_buffer, own, point, settings_.splat);
            ++n.lobes_convolved;
          }
        }
        clock.Charge(Stage::kConvolve);
      }
    }
    n.node_visits += cut_counters.groups_visited * kLanes;
    n.skipped_horizon += cut_counters.below_horizon;
    n.skipped_invisible += cut_counters.invisible_side;
    n.splats += raster_counters.splats;
    n.exact_discs += raster_counters.exact_discs;
    n.skipped_hidden += raster_counters.hidden_pixels;
    n.skipped_hidden_nodes += hidden_counters.nodes;
    n.skipped_hidden_subtrees += cut_counters.hidden_subtrees;
  }

  // Samples to pixels; they were drawn by the filter, so all count alike. False if a value is not
  // finite.
  bool Develop(const PixelRect& block, const PixelRect& inside, const std::vector<Sample>& samples,
               const std::vector<Receiver>& receivers, Film& film) const {
    const uint32_t spp = settings_.spp;
    const float inverse_spp = 1.0f / static_cast<float>(spp);
    const Vec3d origin = scene_.scene->origin();
    bool finite = true;
    for (int y = inside.y0; y < inside.y1; ++y) {
      for (int x = inside.x0; x < inside.x1; ++x) {
        const size_t first =
            (static_cast<size_t>(y - block.y0) * static_cast<size_t>(block.width()) +
             static_cast<size_t>(x - block.x0)) *
            spp;
        Rgb direct, indirect, glossy_indirect, emission, albedo, irradiance, direct_irradiance,
            error;
        Vec3f normal;
        Vec3d position;
        float depth = 0, cluster = 0, cut_size = 0, unhidden = 0;
        uint32_t hits = 0;
        for (uint32_t s = 0; s < spp; ++s) {
          const Sample& sample = samples[first + s];
          if (!sample.hit) {
            emission += sample.emission;
            continue;
          }
          ++hits;
          const Receiver& r = receivers[sample.receiver];
          if (sample.glossy < 0) {
            direct += sample.albedo * sample.direct_e * kInvPif;
            indirect += sample.albedo * sample.indirect_e * kInvPif;
          } else {
            direct += sample.direct_l;
            indirect += sample.diffuse_l;
            glossy_indirect += sample.glossy_l;
          }
          emission += sample.emission;
          albedo += sample.albedo;
          irradiance += sample.indirect_e;
          direct_irradiance += sample.direct_e;
          error += sample.standard_error * sample.standard_error;
          normal += r.normal;
          position += Vec3d(r.position) + origin;
          depth += sample.depth;
          cluster += sample.cluster;
          cut_size += sample.cut_size;
          unhidden += sample.unhidden;
        }
        direct *= inverse_spp;
        indirect *= inverse_spp;
        glossy_indirect *= inverse_spp;
        const Rgb diffuse_indirect = indirect;
        indirect += glossy_indirect;
        emission *= inverse_spp;
        albedo *= inverse_spp;
        // Of what was hit: geometry, and irradiance, which background does not have.
        const float inverse_hits = hits > 0 ? 1.0f / static_cast<float>(hits) : 0.0f;
        irradiance *= inverse_hits;
        direct_irradiance *= inverse_hits;
        const Rgb se =
            Rgb(std::sqrt(error.x), std::sqrt(error.y), std::sqrt(error.z)) * inverse_hits;
        const Rgb beauty = direct + indirect + emission;
        finite = finite && IsFinite(beauty) && std::isfinite(unhidden) && IsFinite(irradiance) &&
                 IsFinite(direct_irradiance);
        const Vec3f p(position * static_cast<double>(inverse_hits));
        const float alpha = static_cast<float>(hits) * inverse_spp;
        for (const Layer layer : film.layers()) {
          const auto set = [&](const Vec3f& v) {
            const float values[3] = {v.x, v.y, v.z};
            film.Set(layer, x, y, values);
          };
          const auto set1 = [&](float v) { film.Set(layer, x, y, std::span<const float>(&v, 1)); };
          switch (layer) {
            case Layer::kBeauty: {
              const float values[4] = {beauty.x, beauty.y, beauty.z, alpha};
              film.Set(layer, x, y, values);
              break;
            }
            case Layer::kDirect:
              set(direct);
              break;
            case Layer::kIndirect:
              set(indirect);
              break;
            case Layer::kEmission:
              set(emission);
              break;
            case Layer::kAlbedo:
              set(albedo);
              break;
            case Layer::kNormal:
              set(NormalizeOr(normal, Vec3f()));
              break;
            case Layer::kPosition:
              set(hits > 0 ? p : Vec3f());
              break;
            case Layer::kDepth:
              set1(hits > 0 ? depth * inverse_hits : std::numeric_limits<float>::infinity());
              break;
            case Layer::kIrradiance:
              set(irradiance);
              break;
            case Layer::kDirectIrradiance:
              set(direct_irradiance);
              break;
            case Layer::kStdError:
              set(se);
              break;
            case Layer::kCluster:
              set1(hits > 0 ? cluster * inverse_hits : -1.0f);
              break;
            case Layer::kCutSize:
              set1(cut_size * inverse_hits);
              break;
            case Layer::kDiffuseIndirect:
              set(diffuse_indirect);
              break;
            case Layer::kGlossyIndirect:
              set(glossy_indirect);
              break;
            case Layer::kAmbientOcclusion:
              // Sums of strata may pass π by their rounding.
              set1(std::clamp(unhidden * kInvPif * inverse_hits, 0.0f, 1.0f));
              break;
          }
        }
      }
    }
    return finite;
  }

  static void Report(const Counters& n, Stats& stats) {
    stats.counts["receivers"] += n.receivers;
    stats.counts["clusters"] += n.clusters;
    stats.counts["cut_nodes"] += n.cut_nodes;
    stats.counts["rays"] += n.rays;
    stats.counts["node_visits"] += n.node_visits;
    stats.counts["splats"] += n.splats;
    stats.counts["exact_discs"] += n.exact_discs;
    stats.counts["cache_records"] += n.own_records;
    stats.counts["clusters_of_samples"] += n.sample_records;
    if (n.glossy_receivers + n.skipped_matte > 0) {
      stats.counts["glossy_receivers"] += n.glossy_receivers;
      stats.counts["lobes_convolved"] += n.lobes_convolved;
      stats.skipped["matte_receivers"] += n.skipped_matte;
    }
    stats.skipped["blocks_without_receivers"] += n.skipped_no_receivers;
    stats.skipped["black_receivers"] += n.skipped_black;
    stats.skipped["unlit_receivers"] += n.skipped_unlit;
    stats.skipped["shadow_rays"] += n.skipped_shadow;
    stats.skipped["nodes_below_horizon"] += n.skipped_horizon;
    stats.skipped["nodes_invisible_side"] += n.skipped_invisible;
    stats.skipped["pixels_hidden"] += n.skipped_hidden;
    stats.skipped["nodes_hidden"] += n.skipped_hidden_nodes;
    stats.skipped["subtrees_hidden"] += n.skipped_hidden_subtrees;
    stats.skipped["environment_terms"] += n.skipped_environments;
    stats.skipped["black_hits"] += n.skipped_black_hits;
  }

  std::shared_ptr<const LoadedScene> holder_;
  const LoadedSceneData& scene_;
  FrameSpec frame_;
  RenderSettings settings_;
  CameraRays rays_;
  MicrobufferMap map_;
  PixelFilterSampler filter_;
  HemisphereGrid ray_grid_;  // of k clusters per block filled by rays
  CutParams cut_params_;
  std::unique_ptr<RecordGatherer> gatherer_;
  std::unique_ptr<const GlossyGatherer> glossy_;          // null: no surface is glossy
  mutable std::once_flag scaled_;                         // on the first tile that needs it:
  mutable std::unique_ptr<ReceiverHierarchy> hierarchy_;  // of adaptive clusters
  mutable std::mutex cache_mutex_;
  mutable std::unique_ptr<const IrradianceCache> cache_;  // irrcache
  bool wants_cluster_;
  bool wants_irradiance_, wants_direct_irradiance_, wants_indirect_, wants_direct_;
  bool hide_;            // leave out of cuts what lies behind a filled part of the buffer
  bool sky_by_records_;  // direct light of a constant sky comes from records
  bool wants_occlusion_ = false;
  bool occlusion_alone_ = false;  // records bring no light
  float ao_distance_m_ = 0;       // 0: nobody asks
};

bool IsRotation(const Camera& c) {
  const auto near = [](double a, double b) { return std::fabs(a - b) < 1e-6; };
  return near(Length2(c.right), 1) && near(Length2(c.up), 1) && near(Length2(c.forward), 1) &&
         near(Dot(c.right, c.up), 0) && near(Dot(c.right, c.forward), 0) &&
         near(Dot(c.up, c.forward), 0);
}

}  // namespace

absl::StatusOr<std::shared_ptr<const LoadedScene>> LoadedScene::Load(const BakedScene& blobs,
                                                                     Executor& executor) {
  (void)executor;  // Embree builds on its own threads
  auto loaded = std::make_shared<LoadedSceneData>();
  FP_ASSIGN_OR_RETURN(loaded->scene, PreparedScene::FromBlob(blobs.prepared_scene));
  FP_ASSIGN_OR_RETURN(loaded->accel, RayAccel::Build(loaded->scene));
  loaded->lights = std::make_unique<LightSampler>(loaded->accel);
  if (blobs.tree_topology.size() != 0) {
    FP_ASSIGN_OR_RETURN(loaded->tree,
                        PointTree::FromBlobs(blobs.tree_topology, blobs.tree_radiance));
  }
  return std::shared_ptr<const LoadedScene>(std::move(loaded));
}

absl::StatusOr<std::unique_ptr<FrameRenderer>> FrameRenderer::Create(
    std::shared_ptr<const LoadedScene> scene, const FrameSpec& frame) {
  FP_RETURN_IF_ERROR(ValidateSettings(frame.settings));
  FP_RETURN_IF_ERROR(ValidateFilm(frame.film));
  const Camera& c = frame.camera;
  if (!IsFinite(c.eye) || !IsRotation(c)) {
    return absl::InvalidArgumentError(
        "camera: eye must be finite and right, up, forward orthonormal");
  }
  // Rays that start further away are none to Embree, which ends the process.
  constexpr double kMaxEyeM = 0x1p60;
  if (!(MaxAbs(c.eye - static_cast<const LoadedSceneData&>(*scene).scene->origin()) <= kMaxEyeM)) {
    return absl::InvalidArgumentError(
        "camera: eye is more than 2^60 m away from the scene; move it closer");
  }
  if (!(c.yfov_rad > 0.0) || !(c.yfov_rad < 3.1)) {
    return absl::InvalidArgumentError(
        "camera: the vertical field of view must lie between 0 and 177 degrees");
  }
  if (frame.settings.point_based() && static_cast<const LoadedSceneData&>(*scene).tree == nullptr) {
    return absl::FailedPreconditionError(
        "a point-based integrator needs a point tree, and the scene was baked without one");
  }
  const Integrator integrator = frame.settings.integrator;
  if (static_cast<const LoadedSceneData&>(*scene).scene->has_gloss() ||
      ((integrator == Integrator::kFpbgi || integrator == Integrator::kIrrcache) &&
       frame.settings.fill_in_force() == Fill::kRays)) {
    FP_RETURN_IF_ERROR(static_cast<const LoadedSceneData&>(*scene).accel->PrepareBundles());
  }
  return std::unique_ptr<FrameRenderer>(std::make_unique<Renderer>(std::move(scene), frame));
}

}  // namespace farpoint
