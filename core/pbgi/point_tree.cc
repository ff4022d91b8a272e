#include "core/pbgi/point_tree.h"

#include <algorithm>
#include <bit>
#include <cmath>
#include <numeric>

#include "core/base/byte_io.h"
#include "core/base/check.h"

namespace farpoint {

namespace {

constexpr uint32_t kTopologyMagic = 0x54545046;  // "FPTT"
constexpr uint32_t kRadianceMagic = 0x52545046;  // "FPTR"
constexpr uint32_t kVersion = 1;
constexpr size_t kPiece = 4096;
constexpr int kHilbertBits = 16;

// What building needs of a node beyond what is stored.
struct BuildNode {
  Box3f centres;     // of all surfels below
  float max_radius;  // of all surfels below
  double area, front_area, back_area;
  Vec3d area_normal;  // Σ A n
  Vec3d area_centre;  // Σ A c
};

void SetEmpty(NodeGroup& g, uint32_t lane) {
  g.cx[lane] = g.cy[lane] = g.cz[lane] = 0;
  g.radius[lane] = -1;
  g.thickness[lane] = 0;
  g.nx[lane] = g.ny[lane] = g.nz[lane] = 0;
  g.sin_cone[lane] = 0;
  g.area[lane] = g.front_area[lane] = g.back_area[lane] = 0;
}

Vec3f Centre(const NodeGroup& g, uint32_t k) { return {g.cx[k], g.cy[k], g.cz[k]}; }
Vec3f MeanNormal(const NodeGroup& g, uint32_t k) { return {g.nx[k], g.ny[k], g.nz[k]}; }

// The node over the group `g` of the level below.
void MakeParent(const NodeGroup& g, const BuildNode* children, uint32_t count, NodeGroup& out,
                uint32_t lane, BuildNode& info) {
  info = BuildNode{};
  for (uint32_t k = 0; k < count; ++k) {
    const BuildNode& c = children[k];
    info.centres.Extend(c.centres.min);
    info.centres.Extend(c.centres.max);
    info.max_radius = std::max(info.max_radius, c.max_radius);
    info.area += c.area;
    info.front_area += c.front_area;
    info.back_area += c.back_area;
    info.area_normal += c.area_normal;
    info.area_centre += c.area_centre;
  }
  const Vec3f centre(info.area_centre / info.area);
  const Vec3f mean(info.area_normal / info.area);
  const Vec3f unit = NormalizeOr(mean, Vec3f(0, 0, 1));
  // Two bounds of the radius: over the children's spheres, and over the box of the surfels.
  float by_children = 0, thickness = 0, cos_cone = 1;
  for (uint32_t k = 0; k < count; ++k) {
    const Vec3f offset = Centre(g, k) - centre;
    by_children = std::max(by_children, Length(offset) + g.radius[k]);
    const Vec3f child_mean = MeanNormal(g, k);
    const Vec3f child_unit = NormalizeOr(child_mean, Vec3f(0, 0, 1));
    const float c = std::min(1.0f, std::fabs(Dot(child_unit, unit)));
    const float tilt = std::sqrt(std::max(0.0f, 1.0f - c * c));
    const float reach = std::min(g.radius[k], g.radius[k] * tilt + g.thickness[k] * c);
    thickness = std::max(thickness, std::fabs(Dot(offset, unit)) + reach);
    // cos(a + b) for the angle a between the normals and the child's own cone b.
    const float cos_a = std::clamp(Dot(child_unit, unit), -1.0f, 1.0f);
    const float sin_a = std::sqrt(std::max(0.0f, 1.0f - cos_a * cos_a));
    const float sin_b = g.sin_cone[k];
    const float cos_b = std::sqrt(std::max(0.0f, 1.0f - sin_b * sin_b));
    cos_cone = std::min(cos_cone, sin_b >= 1.0f ? -1.0f : cos_a * cos_b - sin_a * sin_b);
  }
  const Vec3f corner = Max(info.centres.max - centre, centre - info.centres.min);
  const float by_box = Length(corner) + info.max_radius;
  // A few ulps wider, so that rounding never puts a disc outside.
  const float radius = std::min(by_children, by_box) * (1.0f + 1e-6f);
  out.cx[lane] = centre.x;
  out.cy[lane] = centre.y;
  out.cz[lane] = centre.z;
  out.radius[lane] = radius;
  out.thickness[lane] = std::min(radius, thickness * (1.0f + 1e-6f));
  out.nx[lane] = mean.x;
  out.ny[lane] = mean.y;
  out.nz[lane] = mean.z;
  out.sin_cone[lane] =
      cos_cone <= 0.0f
          ? 1.0f
          : std::min(1.0f, std::sqrt(std::max(0.0f, 1.0f - cos_cone * cos_cone)) + 1e-6f);
  out.area[lane] = static_cast<float>(info.area);
  out.front_area[lane] = static_cast<float>(info.front_area);
  out.back_area[lane] = static_cast<float>(info.back_area);
}

// Mean radiance of a side over the children, weighted by that side's visible area.
void MakeParentRadiance(const NodeGroup& g, const RadianceGroup& r, uint32_t count,
                        RadianceGroup& out, uint32_t lane) {
  double front_area = 0, back_area = 0;
  for (uint32_t k = 0; k < count; ++k) {
    front_area += g.front_area[k];
    back_area += g.back_area[k];
  }
  for (int c = 0; c < 3; ++c) {
    double front = 0, back = 0;
    for (uint32_t k = 0; k < count; ++k) {
      front += static_cast<double>(g.front_area[k]) * r.lane[k].front[c];
      back += static_cast<double>(g.back_area[k]) * r.lane[k].back[c];
    }
    out.lane[lane].front[c] = front_area > 0 ? static_cast<float>(front / front_area) : 0.0f;
    out.lane[lane].back[c] = back_area > 0 ? static_cast<float>(back / back_area) : 0.0f;
  }
}

uint32_t GroupsFor(uint64_t nodes) { return static_cast<uint32_t>((nodes + kLanes - 1) / kLanes); }

// Node counts of all levels, surfels first, up to the first that fits one group.
std::vector<uint64_t> LevelSizes(uint64_t surfels) {
  std::vector<uint64_t> sizes;
  for (uint64_t n = surfels; n > 0; n = GroupsFor(n)) {
    sizes.push_back(n);
    if (n <= kLanes) break;
  }
  return sizes;
}

}  // namespace

unsigned NormalClass(const Vec3f& n) {
  const float ax = std::fabs(n.x), ay = std::fabs(n.y), az = std::fabs(n.z);
  if (ax >= ay && ax >= az) return n.x >= 0 ? 0 : 1;
  if (ay >= az) return n.y >= 0 ? 2 : 3;
  return n.z >= 0 ? 4 : 5;
}

uint64_t HilbertIndex(uint32_t x, uint32_t y, uint32_t z) {
  uint32_t a[3] = {x, y, z};
  for (uint32_t q = 1u << (kHilbertBits - 1); q > 1; q >>= 1) {
    const uint32_t p = q - 1;
    for (uint32_t& v : a) {
      if (v & q) {
        a[0] ^= p;
      } else {
        const uint32_t t = (a[0] ^ v) & p;
        a[0] ^= t;
        v ^= t;
      }
    }
  }
  a[1] ^= a[0];
  a[2] ^= a[1];
  uint32_t t = 0;
  for (uint32_t q = 1u << (kHilbertBits - 1); q > 1; q >>= 1) {
    if (a[2] & q) t ^= q - 1;
  }
  for (uint32_t& v : a) v ^= t;
  uint64_t index = 0;
  for (int bit = kHilbertBits - 1; bit >= 0; --bit) {
    for (const uint32_t v : a) index = (index << 1) | ((v >> bit) & 1u);
  }
  return index;
}

PointTree::Blobs PointTree::Build(const SurfelCloud& cloud, const SurfelShading& shading,
                                  Executor& executor) {
  const size_t n = cloud.size();
  FP_CHECK(shading.front.size() == n && shading.back.size() == n &&
           shading.visible_sides.size() == n);

  // Sort by (class, Hilbert index, position in the cloud).
  Box3f box;
  for (const Vec3f& p : cloud.position) box.Extend(p);
  const float edge = box.empty() ? 0.0f : MaxComponent(box.max - box.min);
  const float scale = edge > 0.0f ? 65535.0f / edge : 0.0f;
  struct Key {
    uint64_t key;
    uint32_t surfel;
    bool operator<(const Key& o) const { return key != o.key ? key < o.key : surfel < o.surfel; }
  };
  std::vector<Key> order(n);
  executor.ForEachPiece(n, kPiece, [&](size_t begin, size_t end) {
    for (size_t i = begin; i < end; ++i) {
      const Vec3f q = (cloud.position[i] - box.min) * scale;
      order[i] = {(static_cast<uint64_t>(NormalClass(cloud.normal[i])) << (3 * kHilbertBits)) |
                      HilbertIndex(static_cast<uint32_t>(q.x), static_cast<uint32_t>(q.y),
                                   static_cast<uint32_t>(q.z)),
                  static_cast<uint32_t>(i)};
    }
  });
  std::sort(order.begin(), order.end());

  const std::vector<uint64_t> sizes = LevelSizes(n);
  std::vector<uint32_t> first_group;
  uint64_t groups = 0;
  for (const uint64_t size : sizes) {
    first_group.push_back(static_cast<uint32_t>(groups));
    groups += GroupsFor(size);
  }
  std::vector<NodeGroup> nodes(groups);
  std::vector<RadianceGroup> radiance(groups, RadianceGroup{});

  std::vector<BuildNode> below(n), above;
  executor.ForEachPiece(n == 0 ? 0 : GroupsFor(n), kPiece / kLanes, [&](size_t begin, size_t end) {
    for (size_t gi = begin; gi < end; ++gi) {
      NodeGroup& g = nodes[gi];
      RadianceGroup& r = radiance[gi];
      for (uint32_t k = 0; k < kLanes; ++k) {
        const size_t at = gi * kLanes + k;
        if (at >= n) {
          SetEmpty(g, k);
          continue;
        }
        const uint32_t i = order[at].surfel;
        const Vec3f p = cloud.position[i];
        const Vec3f normal = cloud.normal[i];
        const float area = cloud.area_m2[i];
        const bool front = (shading.visible_sides[i] & kFrontVisible) != 0;
        const bool back = (shading.visible_sides[i] & kBackVisible) != 0;
        g.cx[k] = p.x;
        g.cy[k] = p.y;
        g.cz[k] = p.z;
        g.radius[k] = std::sqrt(area * 0.318309886183790672f);  // a disc of the surfel's area
        g.thickness[k] = 0;
        g.nx[k] = normal.x;
        g.ny[k] = normal.y;
        g.nz[k] = normal.z;
        g.sin_cone[k] = 0;
        g.area[k] = area;
        g.front_area[k] = front ? area : 0.0f;
        g.back_area[k] = back ? area : 0.0f;
        r.lane[k] = {shading.front[i], shading.back[i]};
        BuildNode& b = below[at];
        b = BuildNode{};
        b.centres.Extend(p);
        b.max_radius = g.radius[k];
        b.area = area;
        b.front_area = g.front_area[k];
        b.back_area = g.back_area[k];
        b.area_normal = Vec3d(normal) * static_cast<double>(area);
        b.area_centre = Vec3d(p) * static_cast<double>(area);
      }
    }
  });

  for (size_t level = 1; level < sizes.size(); ++level) {
    const size_t count = sizes[level];
    above.assign(count, BuildNode{});
    executor.ForEachPiece(GroupsFor(count), kPiece / kLanes, [&](size_t begin, size_t end) {
      for (size_t gi = begin; gi < end; ++gi) {
        NodeGroup& g = nodes[first_group[level] + gi];
        RadianceGroup& r = radiance[first_group[level] + gi];
        for (uint32_t k = 0; k < kLanes; ++k) {
          const size_t at = gi * kLanes + k;
          if (at >= count) {
            SetEmpty(g, k);
            continue;
          }
          const uint32_t children =
              static_cast<uint32_t>(std::min<uint64_t>(kLanes, sizes[level - 1] - at * kLanes));
          const uint32_t child_group = first_group[level - 1] + static_cast<uint32_t>(at);
          MakeParent(nodes[child_group], &below[at * kLanes], children, g, k, above[at]);
          MakeParentRadiance(nodes[child_group], radiance[child_group], children, r, k);
        }
      }
    });
    below.swap(above);
  }

  ByteWriter topology;
  topology.Put(kTopologyMagic);
  topology.Put(kVersion);
  topology.Put<uint64_t>(n);
  topology.PutArray(std::span<const NodeGroup>(nodes));
  Blobs blobs;
  blobs.topology = topology.TakeBlob();
  nodes = {};
  ByteWriter light;
  light.Put(kRadianceMagic);
  light.Put(kVersion);
  light.Put<uint64_t>(n);
  light.PutArray(std::span<const RadianceGroup>(radiance));
  blobs.radiance = light.TakeBlob();
  return blobs;
}

absl::StatusOr<std::shared_ptr<const PointTree>> PointTree::FromBlobs(Blob topology,
                                                                      Blob radiance) {
  auto tree = std::make_shared<PointTree>();
  uint32_t magic = 0, version = 0;
  uint64_t n = 0, n_radiance = 0;
  ByteReader reader(topology.bytes());
  FP_RETURN_IF_ERROR(reader.Get(magic, "magic"));
  if (magic != kTopologyMagic) return absl::DataLossError("this blob is no point tree topology");
  FP_RETURN_IF_ERROR(reader.Get(version, "version"));
  if (version != kVersion) {
    return absl::DataLossError("point tree topology has version " + std::to_string(version) +
                               ", this program reads version " + std::to_string(kVersion));
  }
  FP_RETURN_IF_ERROR(reader.Get(n, "surfel count"));
  FP_RETURN_IF_ERROR(reader.GetArray(tree->groups_, "groups"));
  FP_RETURN_IF_ERROR(reader.ExpectEnd());

  ByteReader light(radiance.bytes());
  FP_RETURN_IF_ERROR(light.Get(magic, "magic"));
  if (magic != kRadianceMagic) return absl::DataLossError("this blob is no point tree radiance");
  FP_RETURN_IF_ERROR(light.Get(version, "version"));
  if (version != kVersion) {
    return absl::DataLossError("point tree radiance has version " + std::to_string(version) +
                               ", this program reads version " + std::to_string(kVersion));
  }
  FP_RETURN_IF_ERROR(light.Get(n_radiance, "surfel count"));
  FP_RETURN_IF_ERROR(light.GetArray(tree->radiance_, "groups"));
  FP_RETURN_IF_ERROR(light.ExpectEnd());

  if (n > (uint64_t{1} << 31) || n != n_radiance) {
    return absl::DataLossError("point tree: topology is of " + std::to_string(n) +
                               " surfels, radiance of " + std::to_string(n_radiance));
  }
  uint64_t groups = 0;
  for (const uint64_t size : LevelSizes(n)) {
    tree->first_group_.push_back(static_cast<uint32_t>(groups));
    groups += GroupsFor(size);
    tree->node_count_ += size;
  }
  if (groups != tree->groups_.size() || groups != tree->radiance_.size()) {
    return absl::DataLossError("point tree of " + std::to_string(n) + " surfels should have " +
                               std::to_string(groups) + " groups, the blobs have " +
                               std::to_string(tree->groups_.size()) + " and " +
                               std::to_string(tree->radiance_.size()));
  }
  // One pass over the numbers: kernels trust them afterwards.
  bool sane = true, lit = false;
  for (const NodeGroup& g : tree->groups_) {
    for (uint32_t k = 0; k < kLanes; ++k) {
      sane &= std::isfinite(g.cx[k]) & std::isfinite(g.cy[k]) & std::isfinite(g.cz[k]) &
              std::isfinite(g.radius[k]) & (g.thickness[k] >= 0) & std::isfinite(g.thickness[k]) &
              (std::fabs(g.nx[k]) <= 1.001f) & (std::fabs(g.ny[k]) <= 1.001f) &
              (std::fabs(g.nz[k]) <= 1.001f) & (g.sin_cone[k] >= 0) & (g.sin_cone[k] <= 1) &
              (g.area[k] >= 0) & std::isfinite(g.area[k]) & (g.front_area[k] >= 0) &
              std::isfinite(g.front_area[k]) & (g.back_area[k] >= 0) &
              std::isfinite(g.back_area[k]);
    }
  }
  for (const RadianceGroup& r : tree->radiance_) {
    for (const RadianceGroup::Sides& sides : r.lane) {
      for (int c = 0; c < 3; ++c) {
        const float front = sides.front[c], back = sides.back[c];
        sane &= (front >= 0) & std::isfinite(front) & (back >= 0) & std::isfinite(back);
        lit |= (front > 0) | (back > 0);
      }
    }
  }
  if (!sane) return absl::DataLossError("point tree holds values that no tree can have");
  tree->surfel_count_ = n;
  tree->lit_ = lit;
  tree->topology_ = std::move(topology);
  tree->radiance_blob_ = std::move(radiance);
  return std::shared_ptr<const PointTree>(std::move(tree));
}

}  // namespace farpoint
