#include "core/pbgi/surfel_sampler.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include "core/math/sampling.h"

namespace farpoint {

namespace {

constexpr int kCandidatesPerSurfel = 8;
// Distance between surfels over sqrt(area / count): with eight candidates each, dart throwing at
// this distance keeps about `count` of them (measured: within 2 % on planes).
constexpr double kSpacingFactor = 0.759;
// Edge of the cubes within which candidates are visited at random, in spacings.
constexpr float kVisitCube = 16.0f;
// Surfels compete only with those of the same side of a thin sheet.
constexpr float kSameSurfaceCosine = 0.5f;

// Hash grid over accepted surfels; cells of one spacing, so neighbours are in 27 cells.
class Grid {
 public:
  Grid(size_t expected, float cell_m) : inverse_cell_(1.0f / cell_m) {
    size_t size = 16;
    while (size < 2 * expected) size *= 2;
    heads_.assign(size, kNone);
  }
  void Insert(uint32_t item, const Vec3f& p) {
    uint32_t& head = heads_[Slot(Cell(p.x), Cell(p.y), Cell(p.z))];
    if (next_.size() <= item) next_.resize(item + 1);
    next_[item] = head;
    head = item;
  }
  // Calls visit(item) for every item in the 27 cells about p (and for some others that share a
  // slot) until it returns true.
  template <typename Visit>
  bool Any(const Vec3f& p, Visit&& visit) const {
    const int64_t cx = Cell(p.x), cy = Cell(p.y), cz = Cell(p.z);
    for (int64_t z = cz - 1; z <= cz + 1; ++z) {
      for (int64_t y = cy - 1; y <= cy + 1; ++y) {
        for (int64_t x = cx - 1; x <= cx + 1; ++x) {
          for (uint32_t i = heads_[Slot(x, y, z)]; i != kNone; i = next_[i]) {
            if (visit(i)) return true;
          }
        }
      }
    }
    return false;
  }

 private:
  static constexpr uint32_t kNone = ~0u;
  int64_t Cell(float v) const { return static_cast<int64_t>(std::floor(v * inverse_cell_)); }
  size_t Slot(int64_t x, int64_t y, int64_t z) const {
    const uint64_t h = static_cast<uint64_t>(x) * 0x9e3779b97f4a7c15ull ^
                       static_cast<uint64_t>(y) * 0xc2b2ae3d27d4eb4full ^
                       static_cast<uint64_t>(z) * 0x165667b19e3779f9ull;
    return (h ^ (h >> 29)) & (heads_.size() - 1);
  }
  float inverse_cell_;
  std::vector<uint32_t> heads_, next_;
};

struct Candidate {
  Vec3f position;
  Vec3f normal;
  uint32_t triangle;
  Vec2f barycentric;
};

SurfelCloud SampleObject(const PreparedScene& scene, const PreparedObject& object,
                         double object_area_m2, double density_per_m2, float spacing_m,
                         uint64_t seed) {
  SurfelCloud out;
  if (!(object_area_m2 > 0)) return out;
  const double wanted = object_area_m2 * density_per_m2 * kCandidatesPerSurfel;
  const uint64_t n = std::max<uint64_t>(kCandidatesPerSurfel, static_cast<uint64_t>(wanted) + 1);
  const uint64_t key = HashKey(seed, object.content_key);

  // Candidate i lies at area (i + 1/2) / n of the object's running sum of areas; those of one
  // triangle are an Owen-scrambled Sobol' set.
  std::vector<Candidate> candidates;
  candidates.reserve(n);
  const float alpha_cutoff = scene.materials()[object.material].alpha_cutoff;
  const bool masked = alpha_cutoff >= 0.0f;
  uint64_t drawn = 0;
  double below = 0;
  for (uint64_t j = 0; j < object.triangle_count; ++j) {
    const uint32_t t = static_cast<uint32_t>(object.first_triangle + j);
    const double area = scene.TriangleArea(t);
    const double first = std::ceil(below / object_area_m2 * static_cast<double>(n) - 0.5);
    below += area;
    const bool last = j + 1 == object.triangle_count;
    const double end = last ? static_cast<double>(n)
                            : std::ceil(below / object_area_m2 * static_cast<double>(n) - 0.5);
    if (!(end > first)) continue;
    const Vec3f normal = scene.GeometricNormal(t);
    const uint32_t triangle_seed = static_cast<uint32_t>(HashKey(key, j));
    const uint32_t in_triangle = static_cast<uint32_t>(end - std::max(first, 0.0));
    for (uint32_t k = 0; k < in_triangle && drawn < n; ++k) {
      const Vec2f b =
          UniformTriangle(OwenSobol(k, 0, triangle_seed), OwenSobol(k, 1, triangle_seed));
      ++drawn;
      // A hole in an alpha mask is no surface.
      if (masked && scene.Alpha(t, b.x, b.y) < alpha_cutoff) continue;
      candidates.push_back({scene.PointOn(t, b.x, b.y), normal, t, b});
    }
  }
  if (candidates.empty()) return out;

  // Visit in a random order, but one cube of kVisitCube spacings after the other, so that what is
  // looked up lies in the cache. The cubes hang on the object, not on the world: they move with it.
  const Vec3f anchor = candidates.front().position;
  const float inverse_cube = 1.0f / (kVisitCube * spacing_m);
  struct Visit {
    uint64_t key;
    uint32_t candidate;
    bool operator<(const Visit& o) const {
      return key != o.key ? key < o.key : candidate < o.candidate;
    }
  };
  std::vector<Visit> order(candidates.size());
  for (uint32_t i = 0; i < order.size(); ++i) {
    const Vec3f q = (candidates[i].position - anchor) * inverse_cube;
    const uint64_t cube = HashKey(static_cast<uint64_t>(static_cast<int64_t>(std::floor(q.x))),
                                  static_cast<uint64_t>(static_cast<int64_t>(std::floor(q.y))),
                                  static_cast<uint64_t>(static_cast<int64_t>(std::floor(q.z))));
    order[i] = {(cube & 0xffffffff00000000ull) | (HashKey(key, i, 77) >> 32), i};
  }
  std::sort(order.begin(), order.end());
  {
    std::vector<Candidate> sorted;
    sorted.reserve(candidates.size());
    for (const Visit& v : order) sorted.push_back(candidates[v.candidate]);
    candidates.swap(sorted);
  }

  Grid grid(candidates.size() / kCandidatesPerSurfel + 1, spacing_m);
  std::vector<uint32_t> accepted;
  const float spacing2 = spacing_m * spacing_m;
  for (uint32_t i = 0; i < candidates.size(); ++i) {
    const Candidate& c = candidates[i];
    const bool taken = grid.Any(c.position, [&](uint32_t a) {
      const Candidate& other = candidates[accepted[a]];
      return Length2(other.position - c.position) < spacing2 &&
             Dot(other.normal, c.normal) > kSameSurfaceCosine;
    });
    if (taken) continue;
    grid.Insert(static_cast<uint32_t>(accepted.size()), c.position);
    accepted.push_back(i);
  }

  // Areas: how many candidates have this surfel as their nearest on the same surface.
  std::vector<uint32_t> share(accepted.size(), 0);
  for (const Candidate& c : candidates) {
    float best = std::numeric_limits<float>::infinity();
    uint32_t owner = 0;
    grid.Any(c.position, [&](uint32_t a) {
      const Candidate& other = candidates[accepted[a]];
      const float d2 = Length2(other.position - c.position);
      if (Dot(other.normal, c.normal) > kSameSurfaceCosine &&
          (d2 < best || (d2 == best && a < owner))) {
        best = d2;
        owner = a;
      }
      return false;
    });
    ++share[owner];
  }

  const double candidate_area = object_area_m2 / static_cast<double>(drawn);
  for (size_t a = 0; a < accepted.size(); ++a) {
    if (share[a] == 0) continue;
    const Candidate& c = candidates[accepted[a]];
    out.position.push_back(c.position);
    out.normal.push_back(c.normal);
    out.area_m2.push_back(static_cast<float>(candidate_area * share[a]));
    out.triangle.push_back(c.triangle);
    out.barycentric.push_back(c.barycentric);
  }
  return out;
}

// Areas of the objects, each summed in order.
std::vector<double> ObjectAreas(const PreparedScene& scene) {
  std::vector<double> areas;
  for (const PreparedObject& o : scene.objects()) {
    double sum = 0;
    for (uint64_t j = 0; j < o.triangle_count; ++j) {
      sum += scene.TriangleArea(static_cast<uint32_t>(o.first_triangle + j));
    }
    areas.push_back(sum);
  }
  return areas;
}

}  // namespace

uint64_t DefaultSurfelCount(const PreparedScene& scene) {
  double area = 0;
  for (const double a : ObjectAreas(scene)) area += a;
  const double edge = static_cast<double>(scene.diagonal_m()) / 500.0;
  const double n = edge > 0 ? area / (edge * edge) : 0;
  return static_cast<uint64_t>(std::clamp(n, 1e5, 4e6));
}

SurfelCloud SampleSurfels(const PreparedScene& scene, uint64_t count, uint64_t seed,
                          Executor& executor) {
  const std::vector<double> areas = ObjectAreas(scene);
  double total = 0;
  for (const double a : areas) total += a;
  SurfelCloud cloud;
  if (!(total > 0) || count == 0) return cloud;
  const double density = static_cast<double>(count) / total;
  const float spacing = static_cast<float>(kSpacingFactor * std::sqrt(1.0 / density));

  std::vector<SurfelCloud> parts(areas.size());
  executor.ForEach(areas.size(), 1, [&](size_t i) {
    parts[i] = SampleObject(scene, scene.objects()[i], areas[i], density, spacing, seed);
  });
  size_t n = 0;
  for (const SurfelCloud& part : parts) n += part.size();
  cloud.position.reserve(n);
  cloud.normal.reserve(n);
  cloud.area_m2.reserve(n);
  cloud.triangle.reserve(n);
  cloud.barycentric.reserve(n);
  for (SurfelCloud& part : parts) {
    cloud.position.insert(cloud.position.end(), part.position.begin(), part.position.end());
    cloud.normal.insert(cloud.normal.end(), part.normal.begin(), part.normal.end());
    cloud.area_m2.insert(cloud.area_m2.end(), part.area_m2.begin(), part.area_m2.end());
    cloud.triangle.insert(cloud.triangle.end(), part.triangle.begin(), part.triangle.end());
    cloud.barycentric.insert(cloud.barycentric.end(), part.barycentric.begin(),
                             part.barycentric.end());
    part = SurfelCloud();
  }
  return cloud;
}

}  // namespace farpoint
