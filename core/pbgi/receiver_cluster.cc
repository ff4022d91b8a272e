#include "core/pbgi/receiver_cluster.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include "core/math/sampling.h"
#include "core/math/simd8.h"

namespace farpoint {

namespace {

constexpr float kMinNormalCosine = 0.5f;
constexpr float kMaxRadiusOverRms = 4.0f;

// α in m².
float NormalWeight(std::span<const Receiver> receivers, const ClusterParams& params) {
  Box3f box;
  for (const Receiver& x : receivers) box.Extend(x.position);
  const Vec3f d = box.max - box.min;
  return params.normal_weight * Dot(d, d);
}

// k distinct receivers, drawn without replacement.
std::vector<uint32_t> DrawSeeds(size_t n, uint32_t k, uint64_t key) {
  std::vector<uint32_t> index(n);
  for (size_t i = 0; i < n; ++i) index[i] = static_cast<uint32_t>(i);
  for (uint32_t i = 0; i < k; ++i) {
    const uint64_t left = n - i;
    // The upper 32 bits times the range: uniform to within 2^-32 n.
    const uint64_t pick = ((HashKey(key, i) >> 32) * left) >> 32;
    std::swap(index[i], index[i + pick]);
  }
  index.resize(k);
  return index;
}

float Distance(const Vec3f& p_x, const Vec3f& n_x, const Vec3f& p_c, const Vec3f& n_c,
               float alpha) {
  const Vec3f dp = p_c - p_x;
  const Vec3f dn = n_c - n_x;
  return Dot(dp, dp) + alpha * Dot(dn, dn);
}

struct Centres {
  std::vector<Vec3f> position, normal;
};

// New centres: mean position, normalised mean normal (§3.1). An empty cluster takes the receiver
// farthest from its own centre; each receiver at most once.
void UpdateCentres(std::span<const Receiver> receivers, const std::vector<uint32_t>& cluster_of,
                   std::vector<float>& distance, Centres& centres) {
  const size_t k = centres.position.size();
  std::vector<Vec3d> position(k), normal(k);
  std::vector<uint32_t> count(k, 0);
  for (size_t i = 0; i < receivers.size(); ++i) {
    const uint32_t c = cluster_of[i];
    position[c] += Vec3d(receivers[i].position);
    normal[c] += Vec3d(receivers[i].normal);
    ++count[c];
  }
  for (size_t c = 0; c < k; ++c) {
    if (count[c] == 0) {
      const size_t worst = static_cast<size_t>(std::max_element(distance.begin(), distance.end()) -
                                               distance.begin());
      centres.position[c] = receivers[worst].position;
      centres.normal[c] = receivers[worst].normal;
      distance[worst] = -1.0f;
      continue;
    }
    centres.position[c] = Vec3f(position[c] / static_cast<double>(count[c]));
    centres.normal[c] = Vec3f(NormalizeOr(normal[c], Vec3d(centres.normal[c])));
  }
}

// Nearest centre of every receiver, eight centres at a time; ties go to the lower index.
void AssignNearest(std::span<const Receiver> receivers, const Centres& centres, float alpha,
                   std::vector<uint32_t>& cluster_of, std::vector<float>& distance) {
  const size_t k = centres.position.size();
  const size_t groups = (k + 7) / 8;
  struct alignas(32) CentreGroup {
    float px[8], py[8], pz[8], nx[8], ny[8], nz[8];
  };
  std::vector<CentreGroup> packed(groups);
  for (size_t c = 0; c < groups * 8; ++c) {
    CentreGroup& g = packed[c / 8];
    const size_t from = std::min(c, k - 1);  // padding repeats the last: a tie that it loses
    g.px[c % 8] = centres.position[from].x;
    g.py[c % 8] = centres.position[from].y;
    g.pz[c % 8] = centres.position[from].z;
    g.nx[c % 8] = centres.normal[from].x;
    g.ny[c % 8] = centres.normal[from].y;
    g.nz[c % 8] = centres.normal[from].z;
  }
  const F8 alpha8 = Set8(alpha);
  for (size_t i = 0; i < receivers.size(); ++i) {
    const Receiver& x = receivers[i];
    const F8 px = Set8(x.position.x), py = Set8(x.position.y), pz = Set8(x.position.z);
    const F8 nx = Set8(x.normal.x), ny = Set8(x.normal.y), nz = Set8(x.normal.z);
    F8 best = Set8(std::numeric_limits<float>::infinity());
    M8 best_group = best == Set8(0.0f);  // all 0
    for (size_t g = 0; g < groups; ++g) {
      const CentreGroup& c = packed[g];
      const F8 dx = Load8(c.px) - px, dy = Load8(c.py) - py, dz = Load8(c.pz) - pz;
      const F8 ex = Load8(c.nx) - nx, ey = Load8(c.ny) - ny, ez = Load8(c.nz) - nz;
      const F8 d = (dx * dx + dy * dy + dz * dz) + alpha8 * (ex * ex + ey * ey + ez * ez);
      const M8 better = d < best;
      best = Select8(better, d, best);
      const M8 group_index = M8{} + static_cast<int32_t>(g);
      best_group = (better & group_index) | (~better & best_group);
    }
    float d_min = std::numeric_limits<float>::infinity();
    uint32_t winner = 0;
    for (int lane = 0; lane < 8; ++lane) {
      const uint32_t c = std::min(static_cast<uint32_t>(best_group[lane]) * 8 + lane,
                                  static_cast<uint32_t>(k - 1));
      if (best[lane] < d_min || (best[lane] == d_min && c < winner)) {
        d_min = best[lane];
        winner = c;
      }
    }
    cluster_of[i] = winner;
    distance[i] = d_min;
  }
}

void AssignNearestLiteral(std::span<const Receiver> receivers, const Centres& centres, float alpha,
                          std::vector<uint32_t>& cluster_of, std::vector<float>& distance) {
  for (size_t i = 0; i < receivers.size(); ++i) {
    distance[i] = std::numeric_limits<float>::infinity();
    for (size_t c = 0; c < centres.position.size(); ++c) {
      const float d = Distance(receivers[i].position, receivers[i].normal, centres.position[c],
                               centres.normal[c], alpha);
      if (d < distance[i]) {
        distance[i] = d;
        cluster_of[i] = static_cast<uint32_t>(c);
      }
    }
  }
}

template <typename Assign>
std::vector<uint32_t> KMeans(std::span<const Receiver> receivers, const ClusterParams& params,
                             Assign&& assign) {
  std::vector<uint32_t> cluster_of(receivers.size(), 0);
  if (receivers.empty()) return cluster_of;
  const uint32_t k = static_cast<uint32_t>(std::clamp<size_t>(params.k, 1, receivers.size()));
  const float alpha = NormalWeight(receivers, params);
  Centres centres;
  for (const uint32_t s : DrawSeeds(receivers.size(), k, params.seed_key)) {
    centres.position.push_back(receivers[s].position);
    centres.normal.push_back(receivers[s].normal);
  }
  std::vector<float> distance(receivers.size());
  assign(receivers, centres, alpha, cluster_of, distance);
  std::vector<uint32_t> previous;
  for (uint32_t it = 0; it < params.iterations; ++it) {
    previous = cluster_of;
    UpdateCentres(receivers, cluster_of, distance, centres);
    assign(receivers, centres, alpha, cluster_of, distance);
    if (cluster_of == previous) break;
  }
  return cluster_of;
}

// Fills in all but `members`, which is set and not empty.
void Measure(std::span<const Receiver> receivers, float alpha, ReceiverCluster& cluster,
             float* rms_m) {
  Vec3d position, normal;
  for (const uint32_t i : cluster.members) {
    position += Vec3d(receivers[i].position);
    normal += Vec3d(receivers[i].normal);
  }
  const Vec3f centre(position / static_cast<double>(cluster.members.size()));
  cluster.mean_normal =
      Vec3f(NormalizeOr(normal, Vec3d(receivers[cluster.members.front()].normal)));
  float best = std::numeric_limits<float>::infinity();
  for (const uint32_t i : cluster.members) {
    const float d =
        Distance(receivers[i].position, receivers[i].normal, centre, cluster.mean_normal, alpha);
    if (d < best) {
      best = d;
      cluster.active = i;
    }
  }
  if (cluster.members.size() == 1) cluster.mean_normal = receivers[cluster.active].normal;
  const Vec3f p_active = receivers[cluster.active].position;
  float radius2 = 0, min_cos = 1, margin = 0;
  double sum2 = 0;
  bool same_normal = true;
  cluster.sees_inside = false;
  for (const uint32_t i : cluster.members) {
    const Receiver& x = receivers[i];
    const Vec3f d = p_active - x.position;
    radius2 = std::max(radius2, Dot(d, d));
    sum2 += static_cast<double>(Dot(d, d));
    min_cos = std::min(min_cos, Dot(x.normal, cluster.mean_normal));
    margin = std::max(margin, Dot(x.normal, d));
    cluster.sees_inside |= x.on_back;
    same_normal &= x.normal == receivers[cluster.active].normal;
  }
  if (same_normal) {
    // A flat cluster: exactly the receivers' own normal, no spread by rounding.
    cluster.mean_normal = receivers[cluster.active].normal;
    min_cos = 1;
  }
  // A few ulps wider: rounding never leaves a member out.
  cluster.radius_m = std::sqrt(radius2) * (1.0f + 1e-6f);
  cluster.margin_m = margin * (1.0f + 1e-6f);
  if (min_cos <= 0.0f) {
    cluster.sin_spread = 1;
    cluster.cos_spread = 0;
  } else if (same_normal) {
    cluster.sin_spread = 0;
    cluster.cos_spread = 1;
  } else {
    const float c = std::max(0.0f, std::min(min_cos, 1.0f) - 1e-6f);
    cluster.cos_spread = c;
    cluster.sin_spread = std::min(1.0f, std::sqrt(1.0f - c * c) + 1e-6f);
  }
  *rms_m = static_cast<float>(std::sqrt(sum2 / static_cast<double>(cluster.members.size())));
}

// Splits by the two members farthest apart: the one worst served by the mean and the one farthest
// from that, under D. False if all members coincide.
bool Split(std::span<const Receiver> receivers, float alpha, ReceiverCluster& cluster,
           ReceiverCluster& other) {
  const auto farthest_from = [&](const Vec3f& p, const Vec3f& n) {
    uint32_t best = cluster.members.front();
    float best_d = -1;
    for (const uint32_t i : cluster.members) {
      const float d = Distance(receivers[i].position, receivers[i].normal, p, n, alpha);
      if (d > best_d) {
        best_d = d;
        best = i;
      }
    }
    return best;
  };
  const uint32_t a = farthest_from(receivers[cluster.active].position, cluster.mean_normal);
  const uint32_t b = farthest_from(receivers[a].position, receivers[a].normal);
  std::vector<uint32_t> stay, leave;
  for (const uint32_t i : cluster.members) {
    const float da = Distance(receivers[i].position, receivers[i].normal, receivers[a].position,
                              receivers[a].normal, alpha);
    const float db = Distance(receivers[i].position, receivers[i].normal, receivers[b].position,
                              receivers[b].normal, alpha);
    (db < da ? leave : stay).push_back(i);
  }
  if (stay.empty() || leave.empty()) return false;
  cluster.members = std::move(stay);
  other.members = std::move(leave);
  return true;
}

}  // namespace

std::vector<uint32_t> AssignClusters(std::span<const Receiver> receivers,
                                     const ClusterParams& params) {
  return KMeans(receivers, params, AssignNearest);
}

std::vector<uint32_t> AssignClustersLiteral(std::span<const Receiver> receivers,
                                            const ClusterParams& params) {
  return KMeans(receivers, params, AssignNearestLiteral);
}

std::vector<ReceiverCluster> ClusterReceivers(std::span<const Receiver> receivers,
                                              const ClusterParams& params) {
  std::vector<ReceiverCluster> clusters;
  if (receivers.empty()) return clusters;
  const std::vector<uint32_t> cluster_of = AssignClusters(receivers, params);
  const float alpha = NormalWeight(receivers, params);
  const size_t k = *std::max_element(cluster_of.begin(), cluster_of.end()) + size_t{1};
  std::vector<ReceiverCluster> raw(k);
  for (size_t i = 0; i < receivers.size(); ++i) {
    raw[cluster_of[i]].members.push_back(static_cast<uint32_t>(i));
  }
  for (ReceiverCluster& c : raw) {
    if (!c.members.empty()) clusters.push_back(std::move(c));
  }
  const size_t most = std::min(receivers.size(), std::max<size_t>(2 * size_t{params.k}, 16));
  for (size_t c = 0; c < clusters.size(); ++c) {
    for (;;) {
      float rms = 0;
      Measure(receivers, alpha, clusters[c], &rms);
      const bool edge = clusters[c].cos_spread < kMinNormalCosine ||
                        clusters[c].radius_m > kMaxRadiusOverRms * rms;
      if (!edge || clusters.size() >= most || clusters[c].members.size() < 2) break;
      ReceiverCluster other;
      if (!Split(receivers, alpha, clusters[c], other)) break;
      clusters.push_back(std::move(other));
    }
  }
  return clusters;
}

}  // namespace farpoint
