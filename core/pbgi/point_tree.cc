#include "core/pbgi/point_tree.h"

#include <algorithm>
#include <bit>
#include <cmath>
#include <cstring>

#include "core/base/byte_io.h"
#include "core/base/check.h"
#include "core/pbgi/key_sort.h"

namespace farpoint {

namespace {

constexpr uint32_t kTopologyMagic = 0x54545046;  // "FPTT"
constexpr uint32_t kRadianceMagic = 0x52545046;  // "FPTR"
constexpr uint32_t kVersion = 2;
constexpr size_t kPiece = 4096;
constexpr int kHilbertBits = 16;

// What building needs of a node beyond what is stored.
struct BuildNode {
  Box3f centres;     // of all surfels below
  float max_radius;  // of all surfels below
  double area;
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

float Sum(const float (&values)[kLanes], uint32_t count) {
  double sum = 0;
  for (uint32_t k = 0; k < count; ++k) sum += static_cast<double>(values[k]);
  return static_cast<float>(sum);
}

BuildNode SurfelNode(const NodeGroup& g, uint32_t k) {
  BuildNode b{};
  b.centres.Extend(Centre(g, k));
  b.max_radius = g.radius[k];
  b.area = g.area[k];
  b.area_normal = Vec3d(MeanNormal(g, k)) * b.area;
  b.area_centre = Vec3d(Centre(g, k)) * b.area;
  return b;
}

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
  out.front_area[lane] = Sum(g.front_area, count);
  out.back_area[lane] = Sum(g.back_area, count);
}

// Visible areas of the nodes of a group.
struct SideAreas {
  float front[kLanes], back[kLanes];
};

// Mean radiance of a side over the children, weighted by that side's visible area.
void MakeParentRadiance(const SideAreas& areas, const RadianceGroup& r, RadianceGroup& out,
                        uint32_t lane) {
  double front_area = 0, back_area = 0;
  for (uint32_t k = 0; k < kLanes; ++k) {
    front_area += areas.front[k];
    back_area += areas.back[k];
  }
  for (int c = 0; c < 3; ++c) {
    double front = 0, back = 0;
    for (uint32_t k = 0; k < kLanes; ++k) {
      front += static_cast<double>(areas.front[k]) * r.lane[k].front[c];
      back += static_cast<double>(areas.back[k]) * r.lane[k].back[c];
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

namespace {

// The levels of a tree over `surfels`.
struct Levels {
  std::vector<uint64_t> sizes;        // nodes, by level
  std::vector<uint32_t> first_group;  // by level
  uint64_t groups = 0;                // of all levels

  explicit Levels(uint64_t surfels) : sizes(LevelSizes(surfels)) {
    for (const uint64_t size : sizes) {
      first_group.push_back(static_cast<uint32_t>(groups));
      groups += GroupsFor(size);
    }
  }
  uint32_t children(size_t level, size_t at) const {
    return static_cast<uint32_t>(std::min<uint64_t>(kLanes, sizes[level - 1] - at * kLanes));
  }
};

// Room for an array at the end of a record, to be filled in place.
template <typename T>
T* AddArray(AlignedVector<std::byte>& record, uint64_t count) {
  const size_t at = record.size();
  const size_t first = (at + sizeof count + kBlobAlignment - 1) / kBlobAlignment * kBlobAlignment;
  record.resize(first + count * sizeof(T));
  std::memcpy(record.data() + at, &count, sizeof count);
  return reinterpret_cast<T*>(record.data() + first);
}

AlignedVector<std::byte> Header(uint32_t magic, uint64_t surfels, size_t reserve) {
  AlignedVector<std::byte> record;
  record.reserve(reserve);
  record.resize(2 * sizeof(uint32_t) + sizeof(uint64_t));
  std::memcpy(record.data(), &magic, sizeof magic);
  std::memcpy(record.data() + 4, &kVersion, sizeof kVersion);
  std::memcpy(record.data() + 8, &surfels, sizeof surfels);
  return record;
}

// Surfels by (class, Hilbert index, position in the cloud).
std::vector<uint32_t> SortSurfels(const SurfelCloud& cloud, Executor& executor) {
  const size_t n = cloud.size();
  Box3f box;
  for (const Vec3f& p : cloud.position) box.Extend(p);
  const float edge = box.empty() ? 0.0f : MaxComponent(box.max - box.min);
  const float scale = edge > 0.0f ? 65535.0f / edge : 0.0f;
  std::vector<KeyedIndex> keys(n);
  executor.ForEachPiece(n, kPiece, [&](size_t begin, size_t end) {
    for (size_t i = begin; i < end; ++i) {
      const Vec3f q = (cloud.position[i] - box.min) * scale;
      keys[i] = {(static_cast<uint64_t>(NormalClass(cloud.normal[i])) << (3 * kHilbertBits)) |
                     HilbertIndex(static_cast<uint32_t>(q.x), static_cast<uint32_t>(q.y),
                                  static_cast<uint32_t>(q.z)),
                 static_cast<uint32_t>(i)};
    }
  });
  SortByKey(keys, executor);
  std::vector<uint32_t> order(n);
  for (size_t i = 0; i < n; ++i) order[i] = keys[i].index;
  return order;
}

}  // namespace

PointTree::Topology PointTree::BuildTopology(const SurfelCloud& cloud,
                                             const SurfelSides& open_sides, Executor& executor) {
  const size_t n = cloud.size();
  FP_CHECK(open_sides.size() == n);
  Topology topology;
  topology.order = SortSurfels(cloud, executor);
  const Levels levels(n);
  auto record = Header(kTopologyMagic, n, 2 * kBlobAlignment + levels.groups * sizeof(NodeGroup));
  NodeGroup* const nodes = AddArray<NodeGroup>(record, levels.groups);

  executor.ForEachPiece(GroupsFor(n), kPiece / kLanes, [&](size_t begin, size_t end) {
    for (size_t gi = begin; gi < end; ++gi) {
      NodeGroup& g = nodes[gi];
      for (uint32_t k = 0; k < kLanes; ++k) {
        const size_t at = gi * kLanes + k;
        if (at >= n) {
          SetEmpty(g, k);
          continue;
        }
        const uint32_t i = topology.order[at];
        const Vec3f p = cloud.position[i];
        const Vec3f normal = cloud.normal[i];
        const float area = cloud.area_m2[i];
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
        g.front_area[k] = (open_sides[i] & kFrontVisible) != 0 ? area : 0.0f;
        g.back_area[k] = (open_sides[i] & kBackVisible) != 0 ? area : 0.0f;
      }
    }
  });

  std::vector<BuildNode> below, above;
  for (size_t level = 1; level < levels.sizes.size(); ++level) {
    const size_t count = levels.sizes[level];
    above.assign(count, BuildNode{});
    executor.ForEachPiece(GroupsFor(count), kPiece / kLanes, [&](size_t begin, size_t end) {
      for (size_t gi = begin; gi < end; ++gi) {
        NodeGroup& g = nodes[levels.first_group[level] + gi];
        for (uint32_t k = 0; k < kLanes; ++k) {
          const size_t at = gi * kLanes + k;
          if (at >= count) {
            SetEmpty(g, k);
            continue;
          }
          const uint32_t children = levels.children(level, at);
          const NodeGroup& child_group = nodes[levels.first_group[level - 1] + at];
          if (level > 1) {
            MakeParent(child_group, &below[at * kLanes], children, g, k, above[at]);
            continue;
          }
          BuildNode surfels[kLanes];
          for (uint32_t c = 0; c < children; ++c) surfels[c] = SurfelNode(child_group, c);
          MakeParent(child_group, surfels, children, g, k, above[at]);
        }
      }
    });
    below.swap(above);
  }
  topology.blob = Blob::FromAligned(std::move(record));
  return topology;
}

Blob PointTree::BuildRadiance(const Topology& topology, const SurfelCloud& cloud,
                              const SurfelSides& open_sides, const SurfelShading& shading,
                              Executor& executor) {
  const size_t n = cloud.size();
  FP_CHECK(topology.order.size() == n && open_sides.size() == n && shading.front.size() == n &&
           shading.back.size() == n && shading.visible_sides.size() == n);
  const Levels levels(n);
  std::vector<uint32_t> lit_sides;
  for (size_t slot = 0; slot < n; ++slot) {
    const uint32_t i = topology.order[slot];
    const unsigned lit = shading.visible_sides[i] & ~static_cast<unsigned>(open_sides[i]);
    if ((lit & kFrontVisible) != 0) lit_sides.push_back(static_cast<uint32_t>(slot * 2));
    if ((lit & kBackVisible) != 0) lit_sides.push_back(static_cast<uint32_t>(slot * 2 + 1));
  }
  auto record = Header(kRadianceMagic, n,
                       4 * kBlobAlignment + lit_sides.size() * sizeof(uint32_t) +
                           levels.groups * sizeof(RadianceGroup));
  std::copy(lit_sides.begin(), lit_sides.end(), AddArray<uint32_t>(record, lit_sides.size()));
  RadianceGroup* const radiance = AddArray<RadianceGroup>(record, levels.groups);

  // The visible areas are summed as those of the nodes are, so that they are the same numbers.
  std::vector<SideAreas> below(GroupsFor(n)), above;
  executor.ForEachPiece(GroupsFor(n), kPiece / kLanes, [&](size_t begin, size_t end) {
    for (size_t gi = begin; gi < end; ++gi) {
      below[gi] = SideAreas{};
      for (uint32_t k = 0; k < kLanes && gi * kLanes + k < n; ++k) {
        const uint32_t i = topology.order[gi * kLanes + k];
        radiance[gi].lane[k] = {shading.front[i], shading.back[i]};
        const unsigned visible = shading.visible_sides[i] | open_sides[i];
        if ((visible & kFrontVisible) != 0) below[gi].front[k] = cloud.area_m2[i];
        if ((visible & kBackVisible) != 0) below[gi].back[k] = cloud.area_m2[i];
      }
    }
  });
  for (size_t level = 1; level < levels.sizes.size(); ++level) {
    const size_t count = levels.sizes[level];
    above.assign(GroupsFor(count), SideAreas{});
    executor.ForEachPiece(GroupsFor(count), kPiece / kLanes, [&](size_t begin, size_t end) {
      for (size_t gi = begin; gi < end; ++gi) {
        for (uint32_t k = 0; k < kLanes && gi * kLanes + k < count; ++k) {
          const size_t at = gi * kLanes + k;
          MakeParentRadiance(below[at], radiance[levels.first_group[level - 1] + at],
                             radiance[levels.first_group[level] + gi], k);
          above[gi].front[k] = Sum(below[at].front, kLanes);
          above[gi].back[k] = Sum(below[at].back, kLanes);
        }
      }
    });
    below.swap(above);
  }
  return Blob::FromAligned(std::move(record));
}

PointTree::Blobs PointTree::Build(const SurfelCloud& cloud, const SurfelShading& shading,
                                  Executor& executor) {
  Topology topology = BuildTopology(cloud, shading.visible_sides, executor);
  Blob radiance = BuildRadiance(topology, cloud, shading.visible_sides, shading, executor);
  return {std::move(topology.blob), std::move(radiance)};
}

uint64_t PointTree::NodeCount(uint64_t surfels) {
  uint64_t nodes = 0;
  for (const uint64_t size : LevelSizes(surfels)) nodes += size;
  return nodes;
}

absl::Status PointTree::AddVisible(std::span<const uint32_t> lit_sides) {
  if (lit_sides.empty()) return absl::OkStatus();
  own_groups_.assign(groups_.begin(), groups_.end());
  std::vector<uint32_t> changed;  // slots of the level at hand, ascending
  for (size_t i = 0; i < lit_sides.size(); ++i) {
    const uint32_t slot = lit_sides[i] / 2;
    if (slot >= surfel_count_ || (i > 0 && lit_sides[i] <= lit_sides[i - 1])) {
      return absl::DataLossError("point tree radiance: entry " + std::to_string(i) +
                                 " of the lit sides is out of order or names no surfel");
    }
    NodeGroup& g = own_groups_[slot / kLanes];
    (lit_sides[i] % 2 == 0 ? g.front_area : g.back_area)[slot % kLanes] = g.area[slot % kLanes];
    if (changed.empty() || changed.back() != slot) changed.push_back(slot);
  }
  const Levels levels(surfel_count_);
  for (size_t level = 1; level < levels.sizes.size(); ++level) {
    size_t kept = 0;
    for (const uint32_t slot : changed) {
      const uint32_t parent = slot / kLanes;
      if (kept > 0 && changed[kept - 1] == parent) continue;
      changed[kept++] = parent;
      const NodeGroup& children = own_groups_[levels.first_group[level - 1] + parent];
      NodeGroup& g = own_groups_[levels.first_group[level] + parent / kLanes];
      g.front_area[parent % kLanes] = Sum(children.front_area, kLanes);
      g.back_area[parent % kLanes] = Sum(children.back_area, kLanes);
    }
    changed.resize(kept);
  }
  groups_ = own_groups_;
  return absl::OkStatus();
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
  std::span<const uint32_t> lit_sides;
  FP_RETURN_IF_ERROR(light.GetArray(lit_sides, "lit sides"));
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
  FP_RETURN_IF_ERROR(tree->AddVisible(lit_sides));
  if (lit_sides.empty()) tree->topology_ = std::move(topology);
  tree->radiance_blob_ = std::move(radiance);
  return std::shared_ptr<const PointTree>(std::move(tree));
}

}  // namespace farpoint
