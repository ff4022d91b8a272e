#include "core/pbgi/cube_darts.h"

#include <algorithm>
#include <atomic>
#include <bit>
#include <limits>

namespace farpoint {

namespace {

// The rows of cells (dz, dy) about one, its own first: of surfels equally near to a candidate the
// first one has it.
constexpr std::array<std::array<int, 2>, 9> kRows = {
    {{0, 0}, {0, -1}, {0, 1}, {-1, 0}, {1, 0}, {-1, -1}, {-1, 1}, {1, -1}, {1, 1}}};

F8 LoadU8(const float* p) { return reinterpret_cast<F8>(_mm256_loadu_ps(p)); }
M8 LoadMask(const int32_t* p) {
  return reinterpret_cast<M8>(_mm256_loadu_si256(reinterpret_cast<const __m256i*>(p)));
}
void StoreMask(int32_t* p, M8 v) {
  _mm256_storeu_si256(reinterpret_cast<__m256i*>(p), reinterpret_cast<__m256i>(v));
}
void StoreU8(float* p, F8 v) { _mm256_storeu_ps(p, reinterpret_cast<__m256>(v)); }

constexpr M8 kLane = {0, 1, 2, 3, 4, 5, 6, 7};
M8 SetM8(int32_t v) { return M8{v, v, v, v, v, v, v, v}; }

}  // namespace

void CubeDarts::Lanes::Resize(size_t count) {
  for (AlignedVector<float>* v : {&x, &y, &z, &nx, &ny, &nz}) {
    if (v->size() < count + 8) v->resize(std::bit_ceil(count + 8));
  }
  for (AlignedVector<float>* v : {&nx, &ny, &nz}) {
    std::fill_n(v->begin() + static_cast<ptrdiff_t>(count), 8, 0.0f);
  }
}

template <int kSide>
template <typename CellOf, typename Place>
void CubeDarts::CellStarts<kSide>::Sort(size_t count, bool last_first, const CellOf& cell_of,
                                        const Place& place) {
  rows_.fill(0);
  counts_.fill(0);
  for (size_t i = 0; i < count; ++i) {
    const uint32_t cell = cell_of(i);
    ++counts_[cell];
    ++rows_[cell / kSide];
  }
  uint32_t at = 0;
  for (size_t row = 0; row < rows_.size(); ++row) {
    if (rows_[row] == 0) continue;
    uint32_t* const counts = &counts_[row * kSide];
    uint32_t* const starts = &starts_[row * (kSide + 1)];
    for (int x = 0; x < kSide; ++x) {
      starts[x] = at;
      at += counts[x];
      // From here on: where the next item of the cell goes.
      counts[x] = last_first ? at : starts[x];
    }
    starts[kSide] = at;
  }
  for (size_t i = 0; i < count; ++i) {
    uint32_t& next = counts_[cell_of(i)];
    place(i, last_first ? --next : next++);
  }
}

void CubeDarts::Clear(float cell) {
  cell2_ = cell * cell;
  raw_.clear();
  surfels_.clear();
}

void CubeDarts::Add(const CandidateLanes& lanes, unsigned inside,
                    const std::array<uint32_t, 3>& first_cell, uint32_t triangle,
                    const Vec3f& normal) {
  const U8 cell =
      ((lanes.cell_z - first_cell[2]) * kCubeCells + (lanes.cell_y - first_cell[1])) * kCubeCells +
      (lanes.cell_x - first_cell[0]);
  for (unsigned rest = inside; rest != 0; rest &= rest - 1) {
    const auto k = static_cast<size_t>(std::countr_zero(rest));
    raw_.push_back({lanes.position.Lane(k), triangle, {lanes.b1[k], lanes.b2[k]}, normal, cell[k]});
  }
}

void CubeDarts::AddSurfel(const LocalCell& cell, const Vec3f& position, const Vec3f& normal,
                          uint32_t* share) {
  const auto outside = [](int c) { return c < -1 || c > kCubeCells; };
  if (outside(cell.x) || outside(cell.y) || outside(cell.z)) return;
  const int at = ((cell.z + 1) * kGridSide + cell.y + 1) * kGridSide + cell.x + 1;
  surfels_.push_back({position, normal, static_cast<uint32_t>(at), share});
}

void CubeDarts::SortCandidates() {
  const size_t n = raw_.size();
  sorted_.Resize(n);
  place_of_.resize(n);
  raw_of_.resize(n);
  candidate_starts_.Sort(
      n, /*last_first=*/false, [&](size_t i) { return raw_[i].cell; },
      [&](size_t i, uint32_t at) {
        sorted_.Set(at, raw_[i].position, raw_[i].normal);
        place_of_[i] = at;
        raw_of_[at] = static_cast<uint32_t>(i);
      });
}

void CubeDarts::Close(const LocalCell& cell, const Vec3f& position, const Vec3f& normal) {
  const V8 p(position), n(normal);
  const F8 cell2 = Set8(cell2_), same_sheet = Set8(kSameSheetCosine);
  const int x0 = std::max(cell.x - 1, 0), x1 = std::min(cell.x + 1, kCubeCells - 1);
  const int y0 = std::max(cell.y - 1, 0), y1 = std::min(cell.y + 1, kCubeCells - 1);
  const int z0 = std::max(cell.z - 1, 0), z1 = std::min(cell.z + 1, kCubeCells - 1);
  for (int z = z0; z <= z1; ++z) {
    for (int row = z * kCubeCells + y0; row <= z * kCubeCells + y1; ++row) {
      if (!candidate_starts_.any(row)) continue;
      const uint32_t end = candidate_starts_.first(row, x1 + 1);
      for (uint32_t i = candidate_starts_.first(row, x0); i < end; i += 8) {
        const V8 d = V8(LoadU8(&sorted_.x[i]), LoadU8(&sorted_.y[i]), LoadU8(&sorted_.z[i])) - p;
        const F8 cosine =
            Dot(V8(LoadU8(&sorted_.nx[i]), LoadU8(&sorted_.ny[i]), LoadU8(&sorted_.nz[i])), n);
        // Lanes beyond the end belong to other cells.
        const M8 closed = (Length2(d) < cell2) & (cosine > same_sheet) &
                          (kLane < SetM8(static_cast<int32_t>(end - i)));
        StoreMask(&open_[i], LoadMask(&open_[i]) & ~closed);
      }
    }
  }
}

void CubeDarts::Throw(uint64_t random, std::vector<AcceptedCandidate>& accepted) {
  SortCandidates();
  const auto n = static_cast<uint32_t>(raw_.size());
  open_.assign(n + 8, -1);
  for (const Surfel& s : surfels_) {
    const auto cell = static_cast<int>(s.cell);
    Close({cell % kGridSide - 1, cell / kGridSide % kGridSide - 1,
           cell / (kGridSide * kGridSide) - 1},
          s.position, s.normal);
  }
  // A random order (Fisher and Yates), drawn as it is needed.
  order_.resize(n);
  for (uint32_t k = 0; k < n; ++k) order_[k] = k;
  for (uint32_t k = 0; k < n; ++k) {
    random = random * 6364136223846793005ull + 1442695040888963407ull;  // Knuth's MMIX
    const auto j = k + static_cast<uint32_t>(((random >> 32) * static_cast<uint64_t>(n - k)) >> 32);
    std::swap(order_[k], order_[j]);
    const uint32_t taken = order_[k];
    if (open_[place_of_[taken]] == 0) continue;
    const Raw& c = raw_[taken];
    const auto cell = static_cast<int>(c.cell);
    Close({cell % kCubeCells, cell / kCubeCells % kCubeCells, cell / (kCubeCells * kCubeCells)},
          c.position, c.normal);
    accepted.push_back({c.position, c.triangle, c.barycentric, 0, c.cell});
  }
}

void CubeDarts::AssignShares() {
  SortCandidates();
  const size_t surfels = surfels_.size();
  by_cell_.Resize(surfels);
  surfel_of_.resize(surfels);
  shares_.assign(surfels, 0);
  surfel_starts_.Sort(
      surfels, /*last_first=*/true, [&](size_t i) { return surfels_[i].cell; },
      [&](size_t i, uint32_t at) {
        by_cell_.Set(at, surfels_[i].position, surfels_[i].normal);
        surfel_of_[at] = static_cast<uint32_t>(i);
      });
  near_.Resize(surfels + 8);
  if (near_place_.size() < surfels + 16) near_place_.resize(std::bit_ceil(surfels + 16));
  const F8 infinity = Set8(std::numeric_limits<float>::infinity());
  const F8 same_sheet = Set8(kSameSheetCosine);

  for (int z = 0; z < kCubeCells; ++z) {
    for (int y = 0; y < kCubeCells; ++y) {
      const int row = z * kCubeCells + y;
      if (!candidate_starts_.any(row)) continue;
      for (int x = 0; x < kCubeCells; ++x) {
        const uint32_t begin = candidate_starts_.first(row, x);
        const uint32_t end = candidate_starts_.first(row, x + 1);
        if (begin == end) continue;
        // The surfels about the cell, side by side.
        uint32_t count = 0;
        for (const auto& [dz, dy] : kRows) {
          const int r = (z + 1 + dz) * kGridSide + y + 1 + dy;
          if (!surfel_starts_.any(r)) continue;
          const uint32_t last = surfel_starts_.first(r, x + 3);
          for (uint32_t i = surfel_starts_.first(r, x); i < last; i += 8) {
            // Whole lanes; those beyond the row's are written over by the next.
            StoreU8(&near_.x[count], LoadU8(&by_cell_.x[i]));
            StoreU8(&near_.y[count], LoadU8(&by_cell_.y[i]));
            StoreU8(&near_.z[count], LoadU8(&by_cell_.z[i]));
            StoreU8(&near_.nx[count], LoadU8(&by_cell_.nx[i]));
            StoreU8(&near_.ny[count], LoadU8(&by_cell_.ny[i]));
            StoreU8(&near_.nz[count], LoadU8(&by_cell_.nz[i]));
            const auto place = reinterpret_cast<__m256i>(kLane + SetM8(static_cast<int32_t>(i)));
            _mm256_storeu_si256(reinterpret_cast<__m256i*>(&near_place_[count]), place);
            count += std::min<uint32_t>(8, last - i);
          }
        }
        for (uint32_t c = begin; c < end; ++c) {
          const V8 p(Vec3f(sorted_.x[c], sorted_.y[c], sorted_.z[c]));
          const V8 n(Vec3f(sorted_.nx[c], sorted_.ny[c], sorted_.nz[c]));
          F8 best = infinity;
          M8 best_at = SetM8(0);
          for (uint32_t i = 0; i < count; i += 8) {
            const V8 d = V8(LoadU8(&near_.x[i]), LoadU8(&near_.y[i]), LoadU8(&near_.z[i])) - p;
            const F8 cosine =
                Dot(V8(LoadU8(&near_.nx[i]), LoadU8(&near_.ny[i]), LoadU8(&near_.nz[i])), n);
            const F8 d2 = Length2(d);
            const M8 at = kLane + SetM8(static_cast<int32_t>(i));
            const M8 nearer =
                (d2 < best) & (cosine > same_sheet) & (at < SetM8(static_cast<int32_t>(count)));
            best = Select8(nearer, d2, best);
            best_at = reinterpret_cast<M8>(
                Select8(nearer, reinterpret_cast<F8>(at), reinterpret_cast<F8>(best_at)));
          }
          float least = best[0];
          for (int k = 1; k < 8; ++k) least = std::min(least, best[k]);
          if (!(least < std::numeric_limits<float>::infinity())) continue;
          // Of the equally near the first in the list.
          int32_t chosen = std::numeric_limits<int32_t>::max();
          for (unsigned m = Bits8(best == Set8(least)); m != 0; m &= m - 1) {
            chosen = std::min(chosen, best_at[std::countr_zero(m)]);
          }
          ++shares_[near_place_[static_cast<size_t>(chosen)]];
        }
      }
    }
  }
  for (size_t at = 0; at < surfels; ++at) {
    if (shares_[at] == 0) continue;
    std::atomic_ref<uint32_t>(*surfels_[surfel_of_[at]].share)
        .fetch_add(shares_[at], std::memory_order_relaxed);
  }
}

}  // namespace farpoint
