#include "core/render/glossy_path_tracer.h"

#include <cmath>
#include <limits>
#include <optional>

#include "core/math/elementary.h"
#include "core/math/sampling.h"

namespace farpoint {

namespace {

constexpr uint32_t kBatches = 8;
enum : uint64_t { kKeyDirection = 51, kKeyLight = 52, kKeyOrder = 53 };

// Paths of one receiver.
class Paths {
 public:
  Paths(const RayAccel& accel, const LightSampler& lights, uint32_t bounces, uint64_t key,
        LightCounters& counters, uint64_t& rays, unsigned needless)
      : accel_(accel),
        scene_(accel.scene()),
        lights_(lights),
        bounces_(bounces),
        key_(key),
        counters_(counters),
        rays_(rays),
        needless_(needless) {}

  struct Draw {
    float u, v;
  };
  // For the direction of path `i` from vertex `bounce`, 0 being the receiver.
  Draw DrawOf(uint32_t i, uint32_t bounce) const {
    const auto seed = static_cast<uint32_t>(HashKey(key_, kKeyDirection, bounce));
    const uint32_t index = IndexOf(i, bounce);
    return {OwenSobol(index, 0, seed), OwenSobol(index, 1, seed)};
  }

  // What arrives along path `i`, which leaves the receiver at `origin` along `w`.
  Rgb Arriving(uint32_t i, const Vec3f& origin, const Vec3f& w) const {
    Rgb sum, throughput(1);
    Vec3f direction = w;
    std::optional<RayHit> hit = Intersect(origin, w);
    for (uint32_t bounce = 1; hit; ++bounce) {
      const bool last = bounce >= bounces_;
      const bool goes_on = scene_.IsGlossy(hit->triangle)
                               ? Glossy(i, bounce, last, direction, throughput, sum, hit)
                               : Lambert(i, bounce, last, direction, throughput, sum, hit);
      if (!goes_on) break;
    }
    return sum;
  }

 private:
  // Scrambles of the same points keep their order of strata: later bounces see the points in
  // another order, or paths would not fill the space of their directions.
  uint32_t IndexOf(uint32_t i, uint32_t bounce) const {
    if (bounce == 0) return i;
    return OwenShuffledIndex(i, static_cast<uint32_t>(HashKey(key_, kKeyOrder, bounce)));
  }
  std::optional<RayHit> Intersect(const Vec3f& origin, const Vec3f& w) const {
    ++rays_;
    return accel_.Intersect(origin, w);
  }
  uint64_t LightKey(uint32_t bounce) const { return HashKey(key_, kKeyLight, bounce); }

  bool Lambert(uint32_t i, uint32_t bounce, bool last, Vec3f& direction, Rgb& throughput, Rgb& sum,
               std::optional<RayHit>& hit) const {
    throughput *= scene_.Surface(hit->triangle, hit->b1, hit->b2).albedo;
    if (!(MaxComponent(throughput) > 0.0f)) {
      ++counters_.skipped_black;
      return false;
    }
    SurfacePoint at;
    at.p = scene_.PointOn(hit->triangle, hit->b1, hit->b2);
    at.ng = scene_.GeometricNormal(hit->triangle);
    at.n = scene_.ShadingNormal(hit->triangle, hit->b1, hit->b2, at.ng);
    if (Dot(at.ng, direction) > 0.0f) {
      at.ng = -at.ng;
      at.n = -at.n;
    }
    at.offset_m = accel_.SurfaceOffsetM(hit->triangle, at.p, at.ng);
    sum += throughput *
           lights_.Irradiance(at, 1, LightKey(bounce), IndexOf(i, bounce), 2, counters_, {}, true,
                              needless_) *
           kInvPif;
    if (last) return false;
    const Draw d = DrawOf(i, bounce);
    direction = Frame(at.n).ToWorld(CosineHemisphere(d.u, d.v));
    if (!(Dot(direction, at.ng) > 0.0f)) return false;
    hit = Intersect(at.Leave(), direction);
    return true;
  }

  bool Glossy(uint32_t i, uint32_t bounce, bool last, Vec3f& direction, Rgb& throughput, Rgb& sum,
              std::optional<RayHit>& hit) const {
    const GlossyPoint point(accel_, *hit, direction);
    const bool extended = lights_.has_emitters() || lights_.has_sky();
    const Both reflector(point, extended);
    sum += throughput * lights_.Reflected(point.surface(), reflector, 1, LightKey(bounce),
                                          IndexOf(i, bounce), 2, counters_, {}, true, needless_);
    if (last && !extended) return false;
    const Draw d = DrawOf(i, bounce);
    const Vec3f local = point.brdf().Sample(d.u, d.v);
    direction = point.ToWorld(local);
    if (!point.Carries(direction, local)) return false;
    const float pdf = point.brdf().Pdf(local);
    if (!(pdf > 0.0f)) return false;
    const MicrofacetBrdf::Value f = point.brdf().Evaluate(local);
    throughput *= (f.diffuse + f.glossy) * (local.z / pdf);
    hit = Intersect(point.surface().Leave(), direction);
    if (extended) {
      const LightSampler::Seen seen = hit ? lights_.EmissionSeen(point.surface(), *hit)
                                          : lights_.EnvironmentSeen(point.surface(), direction);
      sum += throughput * seen.radiance * (pdf / (pdf + seen.density_sr));
    }
    return !last;
  }

  // The whole BRDF by what light samples are worth beside one ray of its own.
  class Both final : public Reflector {
   public:
    Both(const GlossyPoint& point, bool shared) : point_(point), shared_(shared) {}
    Rgb Toward(const Vec3f& w, float density_sr) const override {
      const Vec3f local = point_.ToLocal(w);
      const MicrofacetBrdf::Value f = point_.brdf().Evaluate(local);
      const Rgb all = f.diffuse + f.glossy;
      if (!shared_ || !(density_sr <= std::numeric_limits<float>::max())) return all;
      const float sum = density_sr + point_.brdf().Pdf(local);
      return sum > 0.0f ? all * (density_sr / sum) : Rgb();
    }

   private:
    const GlossyPoint& point_;
    const bool shared_;
  };

  const RayAccel& accel_;
  const PreparedScene& scene_;
  const LightSampler& lights_;
  const uint32_t bounces_;
  const uint64_t key_;
  LightCounters& counters_;
  uint64_t& rays_;
  const unsigned needless_;
};

// Means and the standard error of the sum, from consecutive eighths of the paths.
class Mean {
 public:
  explicit Mean(uint32_t paths) : paths_(paths) {}
  void Add(uint32_t path, const Vec3d& value) {
    batch_[uint64_t{path} * kBatches / paths_] += value;
  }
  Vec3d Value() const {
    Vec3d sum;
    for (const Vec3d& b : batch_) sum += b;
    return sum / static_cast<double>(paths_);
  }
  Rgb StandardError() const {
    if (paths_ < kBatches) return {};
    const Vec3d mean = Value();
    Vec3d variance;
    for (uint32_t b = 0; b < kBatches; ++b) {
      const auto first = [&](uint32_t k) {
        return (uint64_t{k} * paths_ + kBatches - 1) / kBatches;
      };
      const Vec3d d = batch_[b] / static_cast<double>(first(b + 1) - first(b)) - mean;
      variance += d * d;
    }
    variance = variance / (kBatches * (kBatches - 1.0));
    return Rgb(Vec3d(std::sqrt(variance.x), std::sqrt(variance.y), std::sqrt(variance.z)));
  }

 private:
  const uint32_t paths_;
  Vec3d batch_[kBatches];
};

}  // namespace

TracedReflection TraceGlossyIndirect(const RayAccel& accel, const LightSampler& lights,
                                     const GlossyPoint& receiver, uint32_t paths, uint32_t bounces,
                                     uint64_t key, LightCounters& counters, uint64_t& rays,
                                     unsigned needless) {
  const Paths tracer(accel, lights, bounces, key, counters, rays, needless);
  const Vec3f origin = receiver.surface().Leave();
  Vec3d diffuse;
  Mean mean(paths);
  for (uint32_t i = 0; i < paths; ++i) {
    const Paths::Draw d = tracer.DrawOf(i, 0);
    const Vec3f local = receiver.brdf().Sample(d.u, d.v), w = receiver.ToWorld(local);
    const float pdf = receiver.brdf().Pdf(local);
    if (!receiver.Carries(w, local) || !(pdf > 0.0f)) continue;
    const Rgb arriving = tracer.Arriving(i, origin, w) * (local.z / pdf);
    if (!(MaxComponent(arriving) > 0.0f)) continue;
    const MicrofacetBrdf::Value f = receiver.brdf().Evaluate(local);
    diffuse += Vec3d(f.diffuse * arriving);
    mean.Add(i, Vec3d((f.diffuse + f.glossy) * arriving));
  }
  TracedReflection out;
  diffuse = diffuse / static_cast<double>(paths);
  out.diffuse = Rgb(diffuse);
  out.glossy = Max(Rgb(mean.Value() - diffuse), Rgb());
  out.standard_error = mean.StandardError();
  return out;
}

TracedIrradiance TraceIndirectAmongGloss(const RayAccel& accel, const LightSampler& lights,
                                         const Receiver& receiver, uint32_t paths, uint32_t bounces,
                                         uint64_t key, LightCounters& counters, uint64_t& rays,
                                         unsigned needless) {
  const Paths tracer(accel, lights, bounces, key, counters, rays, needless);
  const Frame frame(receiver.normal);
  const Vec3f origin = receiver.Leave();
  Mean mean(paths);
  for (uint32_t i = 0; i < paths; ++i) {
    const Paths::Draw d = tracer.DrawOf(i, 0);
    const Vec3f w = frame.ToWorld(CosineHemisphere(d.u, d.v));
    // Directions that the shading normal allows and the surface does not carry nothing.
    if (!(Dot(w, receiver.geometric_normal) > 0.0f)) continue;
    mean.Add(i, Vec3d(tracer.Arriving(i, origin, w)) * kPi);
  }
  return {Rgb(mean.Value()), mean.StandardError()};
}

}  // namespace farpoint
