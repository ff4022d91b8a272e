#include "core/pbgi/surfel_bounces.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <vector>

#include "core/base/check.h"
#include "core/math/elementary.h"
#include "core/math/sampling.h"
#include "core/pbgi/surfel_atlas.h"
#include "core/pbgi/surfel_shader.h"

namespace farpoint {

namespace {

constexpr uint32_t kLinks = 8;
constexpr uint32_t kNoLink = ~uint32_t{0};
// Sides before and after its own that a surfel looks at for neighbours, and how alike those are.
constexpr size_t kWindow = 48;
constexpr float kReach = 2.5f;       // spacings
constexpr float kSamePlane = 0.25f;  // spacings off the plane
constexpr float kSameNormal = 0.9f;  // cosine
constexpr size_t kPiece = 1024;
enum : uint64_t { kKeyLinks = 41, kKeyHits = 42 };

// One visible side of a surfel; `slot` is its place in the tree.
struct Side {
  uint32_t slot;
  bool back;
};

class Bouncer {
 public:
  Bouncer(const SurfelCloud& cloud, const PointTree::Topology& topology, const RayAccel& accel,
          const LightSampler& lights, const BounceOptions& options, Executor& executor,
          SurfelShading& shading)
      : cloud_(cloud),
        order_(topology.order),
        accel_(accel),
        lights_(lights),
        options_(options),
        executor_(executor),
        shading_(shading) {}

  void Run(const PointTree& tree, Stats& stats) {
    FindSides();
    Link(SurfelGrid(tree), stats);
    const size_t n = cloud_.size();
    shading_.indirect_front.assign(n, Rgb());
    shading_.indirect_back.assign(n, Rgb());
    const double direct = Reflected([&](size_t i) { return Radiance(i); });
    std::vector<Rgb> direct_of(sides_.size()), gathered(sides_.size()), before(sides_.size());
    ForEachSide([&](size_t i) { direct_of[i] = Radiance(i); });
    uint32_t bounce = 1;
    while (bounce < options_.bounces && direct > 0) {
      ForEachSide([&](size_t i) {
        before[i] = Indirect(i);
        gathered[i] = Gathered(i);
      });
      ForEachSide([&](size_t i) { Indirect(i) = Shared(i, gathered); });
      ForEachSide(
          [&](size_t i) { Radiance(i) = direct_of[i] + albedo_[i] * Indirect(i) * kInvPif; });
      ++bounce;
      const double change = Reflected([&](size_t i) {
        const Rgb d = Indirect(i) - before[i];
        return albedo_[i] * Rgb(std::fabs(d.x), std::fabs(d.y), std::fabs(d.z)) * kInvPif;
      });
      if (change < options_.least_change * Reflected([&](size_t i) { return Radiance(i); })) break;
    }
    stats.counts["bounces"] += bounce;
    stats.skipped["bounces"] += options_.bounces - bounce;
  }

 private:
  uint32_t SurfelOf(size_t i) const { return order_[sides_[i].slot]; }
  Rgb& Radiance(size_t i) { return (sides_[i].back ? shading_.back : shading_.front)[SurfelOf(i)]; }
  Rgb& Indirect(size_t i) {
    return (sides_[i].back ? shading_.indirect_back : shading_.indirect_front)[SurfelOf(i)];
  }
  // The outward normal of a side.
  Vec3f NormalOf(size_t i) const {
    const Vec3f& n = cloud_.normal[SurfelOf(i)];
    return sides_[i].back ? -n : n;
  }

  template <typename Body>
  void ForEachSide(const Body& body) {
    executor_.ForEachPiece(sides_.size(), kPiece, [&](size_t begin, size_t end) {
      for (size_t i = begin; i < end; ++i) body(i);
    });
  }
  // Σ A (r + g + b), in a fixed order.
  template <typename Value>
  double Reflected(const Value& value) {
    std::vector<double> sums((sides_.size() + kPiece - 1) / kPiece);
    executor_.ForEachPiece(sides_.size(), kPiece, [&](size_t begin, size_t end) {
      double sum = 0;
      for (size_t i = begin; i < end; ++i) {
        const Rgb v = value(i);
        sum += static_cast<double>(cloud_.area_m2[SurfelOf(i)]) *
               (static_cast<double>(v.x) + static_cast<double>(v.y) + static_cast<double>(v.z));
      }
      sums[begin / kPiece] = sum;
    });
    double sum = 0;
    for (const double s : sums) sum += s;
    return sum;
  }

  // Visible sides that reflect anything, in the order of the tree.
  void FindSides() {
    const PreparedScene& scene = accel_.scene();
    const size_t n = order_.size();
    std::vector<Rgb> albedo(n);
    executor_.ForEachPiece(n, kPiece, [&](size_t begin, size_t end) {
      for (size_t slot = begin; slot < end; ++slot) {
        const uint32_t s = order_[slot];
        const Vec2f b = cloud_.barycentric[s];
        albedo[slot] = scene.Surface(cloud_.triangle[s], b.x, b.y).albedo;
      }
    });
    first_.resize(n + 1);
    for (uint32_t slot = 0; slot < n; ++slot) {
      first_[slot] = static_cast<uint32_t>(sides_.size());
      if (!(MaxComponent(albedo[slot]) > 0.0f)) continue;
      const unsigned visible = shading_.visible_sides[order_[slot]];
      for (const bool back : {false, true}) {
        if ((visible & (back ? kBackVisible : kFrontVisible)) == 0) continue;
        sides_.push_back({slot, back});
        albedo_.push_back(albedo[slot]);
      }
    }
    first_[n] = static_cast<uint32_t>(sides_.size());
  }
  // The place in sides_, or kNoLink: it reflects nothing.
  uint32_t PlaceOf(uint32_t slot, bool back) const {
    for (uint32_t i = first_[slot]; i < first_[slot + 1]; ++i) {
      if (sides_[i].back == back) return i;
    }
    return kNoLink;
  }

  // Traces the links. What a ray hits far from any surfel is shaded instead, by direct light alone.
  void Link(const SurfelGrid& grid, Stats& stats) {
    const PreparedScene& scene = accel_.scene();
    links_.resize(sides_.size() * kLinks);
    shaded_.resize(sides_.size());
    std::vector<std::array<uint64_t, 2>> counts((sides_.size() + kPiece - 1) / kPiece);
    executor_.ForEachPiece(sides_.size(), kPiece, [&](size_t begin, size_t end) {
      uint64_t rays = 0, links = 0;
      LightCounters counters;
      for (size_t i = begin; i < end; ++i) {
        const uint32_t s = SurfelOf(i), triangle = cloud_.triangle[s];
        const Vec3f ng = NormalOf(i), p = cloud_.position[s];
        const Vec2f b = cloud_.barycentric[s];
        const Vec3f n = scene.ShadingNormal(triangle, b.x, b.y);
        const Frame frame(sides_[i].back ? -n : n);
        const Vec3f origin = accel_.LeaveSurface(triangle, p, ng);
        const uint64_t key =
            HashKey(SurfelKey(cloud_, s, scene, options_.seed), sides_[i].back, kKeyLinks);
        const auto seed = static_cast<uint32_t>(key);
        Rgb shaded;
        for (uint32_t r = 0; r < kLinks; ++r) {
          uint32_t& link = links_[i * kLinks + r];
          link = kNoLink;
          const Vec3f w =
              frame.ToWorld(CosineHemisphere(OwenSobol(r, 0, seed), OwenSobol(r, 1, seed)));
          if (!(Dot(w, ng) > 0.0f)) continue;
          ++rays;
          const std::optional<RayHit> hit = accel_.Intersect(origin, w);
          if (!hit) continue;
          const Vec3f at = scene.PointOn(hit->triangle, hit->b1, hit->b2);
          const Vec3f normal = scene.GeometricNormal(hit->triangle);
          if (const auto found = grid.FindVisible(at, normal, hit->front)) {
            ++links;
            link = PlaceOf(found->slot, !found->front);
            continue;
          }
          const Rgb albedo = scene.Surface(hit->triangle, hit->b1, hit->b2).albedo;
          if (!(MaxComponent(albedo) > 0.0f)) continue;
          const float side = hit->front ? 1.0f : -1.0f;
          const Vec3f shading = scene.ShadingNormal(hit->triangle, hit->b1, hit->b2, normal);
          const SurfacePoint point{at, normal * side, shading * side,
                                   accel_.SurfaceOffsetM(hit->triangle, at, normal)};
          shaded += albedo * lights_.Irradiance(point, 1, HashKey(key, kKeyHits), r, 0, counters) *
                    kInvPif;
        }
        shaded_[i] = shaded;
      }
      counts[begin / kPiece] = {rays + counters.rays, links};
    });
    for (const auto& [rays, links] : counts) {
      stats.counts["bounce_rays"] += rays;
      stats.counts["bounce_links"] += links;
    }
  }

  // The irradiance that the links bring.
  Rgb Gathered(size_t i) {
    Rgb sum = shaded_[i];
    for (uint32_t r = 0; r < kLinks; ++r) {
      const uint32_t link = links_[i * kLinks + r];
      if (link != kNoLink) sum += Radiance(link);
    }
    return sum * (kPif / static_cast<float>(kLinks));
  }

  // The mean over the neighbours.
  Rgb Shared(size_t i, const std::vector<Rgb>& gathered) const {
    const uint32_t s = SurfelOf(i);
    const Vec3f p = cloud_.position[s], n = NormalOf(i);
    const float spacing2 = cloud_.area_m2[s];
    Rgb sum;
    uint32_t count = 0;
    const size_t begin = i < kWindow ? 0 : i - kWindow;
    const size_t end = std::min(sides_.size(), i + kWindow + 1);
    for (size_t j = begin; j < end; ++j) {
      const uint32_t other = SurfelOf(j);
      const Vec3f d = cloud_.position[other] - p;
      if (!(Length2(d) <= kReach * kReach * spacing2)) continue;
      if (!(Dot(NormalOf(j), n) >= kSameNormal)) continue;
      const float off = Dot(d, n);
      if (!(off * off <= kSamePlane * kSamePlane * spacing2)) continue;
      sum += gathered[j];
      ++count;
    }
    // A side is its own neighbour unless its area is 0.
    return count == 0 ? gathered[i] : sum / static_cast<float>(count);
  }

  const SurfelCloud& cloud_;
  const BulkVector<uint32_t>& order_;
  const RayAccel& accel_;
  const LightSampler& lights_;
  const BounceOptions& options_;
  Executor& executor_;
  SurfelShading& shading_;

  std::vector<Side> sides_;
  std::vector<Rgb> albedo_;      // by side
  std::vector<uint32_t> first_;  // by slot: its first side
  std::vector<uint32_t> links_;  // kLinks a side: places in sides_, or kNoLink
  std::vector<Rgb> shaded_;      // by side: Σ of the radiance of hits without a surfel
};

}  // namespace

absl::Status AddBounces(const SurfelCloud& cloud, const SurfelSides& open_sides,
                        const PointTree::Topology& topology, const RayAccel& accel,
                        const LightSampler& lights, const BounceOptions& options,
                        Executor& executor, SurfelShading& shading, Stats& stats) {
  FP_CHECK(options.bounces >= 1 && shading.front.size() == cloud.size());
  FP_ASSIGN_OR_RETURN(
      const std::shared_ptr<const PointTree> tree,
      PointTree::FromBlobs(
          topology.blob, PointTree::BuildRadiance(topology, cloud, open_sides, shading, executor)));
  Bouncer(cloud, topology, accel, lights, options, executor, shading).Run(*tree, stats);
  return absl::OkStatus();
}

}  // namespace farpoint
