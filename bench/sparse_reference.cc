#include "bench/sparse_reference.h"

#include <algorithm>
#include <bit>
#include <cmath>
#include <filesystem>
#include <mutex>
#include <optional>
#include <utility>

#include "absl/strings/str_format.h"
#include "core/base/byte_io.h"
#include "core/math/sampling.h"

namespace farpoint {

namespace {

constexpr uint64_t kMagic = 0x3246455245535046ull;  // "FPSEREF2"
// Raised whenever what pt estimates, or its standard error, changes.
constexpr uint32_t kEstimateVersion = 1;
constexpr uint32_t kMaxPaths = 1u << 20;
constexpr size_t kPilotPixels = 256;
constexpr uint32_t kPilotPaths[2] = {64, 256};

// Keys of independent random choices.
enum : uint64_t { kKeyJitter = 1, kKeyPilot = 2, kKeyRound = 3, kKeyDirect = 4 };

uint64_t Bits(double value) { return std::bit_cast<uint64_t>(value); }

Digest KeyOf(const SparseFrame& frame, std::span<const PixelPosition> pixels,
             const SparseReferenceOptions& options) {
  Sha256 hash;
  hash.UpdateU64(kMagic).UpdateU32(kEstimateVersion);
  hash.Update(std::as_bytes(std::span(frame.prepared_scene.bytes)));
  const Camera& c = frame.camera;
  for (const Vec3d& v : {c.eye, c.right, c.up, c.forward}) {
    for (int i = 0; i < 3; ++i) hash.UpdateU64(Bits(v[i]));
  }
  hash.UpdateU64(Bits(c.yfov_rad));
  hash.UpdateU32(static_cast<uint32_t>(frame.film.width));
  hash.UpdateU32(static_cast<uint32_t>(frame.film.height));
  hash.UpdateU32(options.direct_samples).UpdateU64(options.seed).UpdateU64(pixels.size());
  for (const PixelPosition& p : pixels) {
    hash.UpdateU32(static_cast<uint32_t>(p.x)).UpdateU32(static_cast<uint32_t>(p.y));
  }
  return hash.Finish();
}

Rgb GetRgb(const Film& film, Layer layer, int x, int y) {
  return {film.Get(layer, 0, x, y), film.Get(layer, 1, x, y), film.Get(layer, 2, x, y)};
}

Rgb HalfDifference(const Rgb& a, const Rgb& b) {
  const Rgb d = (a - b) * 0.5f;
  return {std::fabs(d.x), std::fabs(d.y), std::fabs(d.z)};
}

// Renders pixels by pt, each as a tile.
class PixelTracer {
 public:
  PixelTracer(const SparseFrame& frame, Executor& executor) : frame_(frame), executor_(executor) {}

  struct Pass {
    std::vector<Film> films;  // of one pixel each
    double seconds = 0;       // thread-seconds, all stages
  };
  absl::StatusOr<Pass> Render(std::span<const PixelPosition> pixels, RenderSettings settings,
                              const std::function<void(double)>& part) const {
    settings.integrator = Integrator::kPt;
    FP_ASSIGN_OR_RETURN(
        const auto renderer,
        FrameRenderer::Create(frame_.scene, FrameSpec{frame_.camera, frame_.film, settings}));
    Pass pass;
    pass.films.resize(pixels.size());
    std::vector<double> seconds(pixels.size());
    std::mutex mutex;
    absl::Status failed;
    size_t done = 0;
    Executor alone(1);
    executor_.ForEach(pixels.size(), 1, [&](size_t i) {
      const PixelPosition& p = pixels[i];
      absl::StatusOr<TileOutput> out =
          renderer->RenderTile({p.x, p.y, p.x + 1, p.y + 1}, alone, {}, nullptr);
      const std::lock_guard lock(mutex);
      if (!out.ok()) {
        failed = out.status();
        return;
      }
      pass.films[i] = std::move(out->film);
      for (const double s : out->stats.seconds) seconds[i] += s;
      part(static_cast<double>(++done) / static_cast<double>(pixels.size()));
    });
    FP_RETURN_IF_ERROR(failed);
    for (const double s : seconds) pass.seconds += s;
    return pass;
  }

 private:
  const SparseFrame& frame_;
  Executor& executor_;
};

RenderSettings IndirectSettings(uint32_t paths, uint64_t seed) {
  RenderSettings settings;
  settings.paths = paths;
  settings.seed = seed;
  settings.layers = {Layer::kIrradiance, Layer::kDepth, Layer::kAlbedo};
  return settings;
}

// One half of a round. Receivers are the same for both.
void Store(const PixelTracer::Pass& pass, std::span<const PixelPosition> pixels, int half,
           SparseReference& out) {
  const size_t n = pixels.size();
  out.hit.assign(n, 0);
  out.albedo.assign(n, Rgb());
  std::vector<Rgb>& values = out.indirect_half[static_cast<size_t>(half)];
  values.assign(n, Rgb());
  for (size_t i = 0; i < n; ++i) {
    const int x = pixels[i].x, y = pixels[i].y;
    const Film& film = pass.films[i];
    out.hit[i] = std::isfinite(film.Get(Layer::kDepth, 0, x, y));
    out.albedo[i] = GetRgb(film, Layer::kAlbedo, x, y);
    values[i] = GetRgb(film, Layer::kIrradiance, x, y);
  }
}

// Adds an independent round of as many paths to the means.
void Average(const SparseReference& round, SparseReference& mean) {
  const float n = static_cast<float>(mean.rounds);
  for (size_t h = 0; h < 2; ++h) {
    for (size_t i = 0; i < mean.hit.size(); ++i) {
      mean.indirect_half[h][i] =
          (mean.indirect_half[h][i] * n + round.indirect_half[h][i]) / (n + 1.0f);
    }
  }
}

std::vector<PixelPosition> Thinned(std::span<const PixelPosition> pixels, size_t count) {
  std::vector<PixelPosition> few;
  const size_t step = std::max<size_t>(1, pixels.size() / count);
  for (size_t i = step / 2; i < pixels.size(); i += step) few.push_back(pixels[i]);
  return few;
}

// Paths for each half.
absl::StatusOr<uint32_t> Pilot(const PixelTracer& tracer, std::span<const PixelPosition> pixels,
                               const SparseReferenceOptions& options) {
  const std::vector<PixelPosition> few = Thinned(pixels, kPilotPixels);
  double noise[2], seconds[2];
  for (int i = 0; i < 2; ++i) {
    SparseReference pilot;
    seconds[i] = 0;
    for (int half = 0; half < 2; ++half) {
      const uint64_t seed = HashKey(options.seed, kKeyPilot, static_cast<uint64_t>(2 * i + half));
      FP_ASSIGN_OR_RETURN(
          const PixelTracer::Pass pass,
          tracer.Render(few, IndirectSettings(kPilotPaths[i], seed), [](double) {}));
      Store(pass, few, half, pilot);
      seconds[i] += pass.seconds;
    }
    noise[i] = pilot.IndirectNoise();
  }
  // Between random and quasi-random convergence.
  double slope = 0.5;
  if (noise[0] > 0 && noise[1] > 0) {
    slope = std::clamp(std::log(noise[0] / noise[1]) /
                           std::log(static_cast<double>(kPilotPaths[1]) / kPilotPaths[0]),
                       0.5, 0.9);
  }
  const double needed = noise[1] > options.noise
                            ? kPilotPaths[1] * std::pow(noise[1] / options.noise, 1.0 / slope)
                            : static_cast<double>(options.min_paths);
  // Of a path for each half. The primary rays of a block are the same for all numbers of paths;
  // where the clock does not tell the two pilots apart, they are counted in.
  const double traced = static_cast<double>(few.size());
  const double more_s = seconds[1] - seconds[0];
  const double seconds_per_path = more_s > 0 ? more_s / (traced * (kPilotPaths[1] - kPilotPaths[0]))
                                             : seconds[1] / (traced * kPilotPaths[1]);
  double affordable = options.budget_s > 0 ? static_cast<double>(kMaxPaths) : 0.0;
  if (seconds_per_path > 0) {
    affordable = options.budget_s / (seconds_per_path * static_cast<double>(pixels.size()));
  }
  const double most = std::min(affordable, static_cast<double>(kMaxPaths));
  // A power of two keeps Sobol' points balanced: the next above what is needed, unless the budget
  // ends below it.
  uint32_t paths = std::bit_ceil(std::max(8u, options.min_paths));
  while (paths < needed && 2.0 * paths <= most) paths *= 2;
  return paths;
}

absl::Status TraceDirect(const PixelTracer& tracer, std::span<const PixelPosition> pixels,
                         const SparseReferenceOptions& options, SparseReference& out) {
  for (int i = 0; i < 2; ++i) {
    RenderSettings settings;
    settings.paths = 1;
    settings.light_samples = options.direct_samples;
    settings.seed = HashKey(options.seed, kKeyDirect, static_cast<uint64_t>(i));
    settings.layers = {Layer::kDirectIrradiance};
    FP_ASSIGN_OR_RETURN(const PixelTracer::Pass pass,
                        tracer.Render(pixels, settings, [](double) {}));
    for (size_t p = 0; p < pixels.size(); ++p) {
      out.direct_half[static_cast<size_t>(i)].push_back(
          GetRgb(pass.films[p], Layer::kDirectIrradiance, pixels[p].x, pixels[p].y));
    }
  }
  return absl::OkStatus();
}

absl::Status PutInCache(const std::string& path, const SparseReference& reference,
                        const Digest& key) {
  if (path.empty()) return absl::OkStatus();
  return WriteFileAtomically(path, EncodeSparseReference(reference, key));
}

}  // namespace

std::vector<PixelPosition> StratifiedPixels(const PixelRect& rect, size_t count, uint64_t seed) {
  std::vector<PixelPosition> pixels;
  if (rect.empty() || count == 0) return pixels;
  const int side = std::max(1, static_cast<int>(std::sqrt(static_cast<double>(rect.area()) /
                                                          static_cast<double>(count))));
  for (int y = rect.y0; y < rect.y1; y += side) {
    for (int x = rect.x0; x < rect.x1; x += side) {
      const uint64_t bits = HashKey(seed, kKeyJitter, static_cast<uint64_t>(x - rect.x0),
                                    static_cast<uint64_t>(y - rect.y0));
      const uint64_t width = static_cast<uint64_t>(std::min(side, rect.x1 - x));
      const uint64_t height = static_cast<uint64_t>(std::min(side, rect.y1 - y));
      pixels.push_back({x + static_cast<int>((bits >> 32) % width),
                        y + static_cast<int>((bits & 0xffffffffu) % height)});
    }
  }
  return pixels;
}

Rgb SparseReference::IndirectError(size_t i) const {
  return HalfDifference(indirect_half[0][i], indirect_half[1][i]);
}
Rgb SparseReference::DirectError(size_t i) const {
  return HalfDifference(direct_half[0][i], direct_half[1][i]);
}
double SparseReference::IndirectNoise() const {
  return NoiseOfHalves(hit, indirect_half[0], indirect_half[1]);
}
double SparseReference::DirectNoise() const {
  // Empty halves if it was not asked for.
  return direct_half[0].empty() ? 0.0 : NoiseOfHalves(hit, direct_half[0], direct_half[1]);
}

double NoiseOfHalves(std::span<const uint8_t> on, std::span<const Rgb> a, std::span<const Rgb> b) {
  double sum = 0, square = 0, n = 0;
  for (size_t i = 0; i < on.size(); ++i) {
    if (on[i] == 0) continue;
    for (int c = 0; c < 3; ++c) {
      const double va = static_cast<double>(a[i][c]), vb = static_cast<double>(b[i][c]);
      sum += 0.5 * (va + vb);
      square += 0.25 * (va - vb) * (va - vb);
      n += 1;
    }
  }
  return sum > 0 ? std::sqrt(square * n) / sum : 0.0;
}

std::vector<std::byte> EncodeSparseReference(const SparseReference& r, const Digest& key) {
  ByteWriter out;
  out.Put(kMagic);
  out.Put(key.bytes);
  out.Put<uint32_t>(r.paths);
  out.Put<uint32_t>(r.rounds);
  out.Put<double>(r.seconds);
  const bool direct = !r.direct_half[0].empty();
  out.Put<uint32_t>(direct ? 1 : 0);
  out.PutArray(std::span<const uint8_t>(r.hit));
  for (const std::vector<Rgb>* values : {&r.indirect_half[0], &r.indirect_half[1], &r.albedo}) {
    out.PutArray(std::span<const Rgb>(*values));
  }
  if (direct) {
    out.PutArray(std::span<const Rgb>(r.direct_half[0]));
    out.PutArray(std::span<const Rgb>(r.direct_half[1]));
  }
  std::vector<std::byte> bytes = out.Take();
  const Digest checksum = HashBytes(bytes);
  const auto tail = std::as_bytes(std::span(checksum.bytes));
  bytes.insert(bytes.end(), tail.begin(), tail.end());
  return bytes;
}

absl::StatusOr<SparseReference> DecodeSparseReference(std::span<const std::byte> bytes,
                                                      const Digest& key, size_t pixels) {
  Digest checksum;
  if (bytes.size() < checksum.bytes.size()) return absl::DataLossError("too short");
  const auto body = bytes.first(bytes.size() - checksum.bytes.size());
  std::memcpy(checksum.bytes.data(), bytes.data() + body.size(), checksum.bytes.size());
  if (HashBytes(body) != checksum) return absl::DataLossError("its checksum is wrong");
  ByteReader in(body);
  uint64_t magic = 0;
  FP_RETURN_IF_ERROR(in.Get(magic, "magic"));
  Digest stored;
  FP_RETURN_IF_ERROR(in.Get(stored.bytes, "key"));
  if (magic != kMagic || stored != key) {
    return absl::DataLossError("it holds the reference of another frame");
  }
  SparseReference r;
  uint32_t direct = 0;
  FP_RETURN_IF_ERROR(in.Get(r.paths, "paths"));
  FP_RETURN_IF_ERROR(in.Get(r.rounds, "rounds"));
  FP_RETURN_IF_ERROR(in.Get(r.seconds, "seconds"));
  FP_RETURN_IF_ERROR(in.Get(direct, "direct"));
  if (r.paths == 0 || r.paths > kMaxPaths || r.rounds == 0 || r.rounds > kMaxPaths || direct > 1 ||
      !(r.seconds >= 0) || !std::isfinite(r.seconds)) {
    return absl::DataLossError("its header makes no sense");
  }
  std::span<const uint8_t> hit;
  FP_RETURN_IF_ERROR(in.GetArray(hit, "hit"));
  if (hit.size() != pixels) return absl::DataLossError("it has another number of pixels");
  r.hit.assign(hit.begin(), hit.end());
  const auto rgb = [&](std::vector<Rgb>& values, std::string_view field) -> absl::Status {
    std::span<const Rgb> view;
    FP_RETURN_IF_ERROR(in.GetArray(view, field));
    if (view.size() != pixels) return absl::DataLossError("it has another number of pixels");
    for (const Rgb& v : view) {
      if (!IsFinite(v)) return absl::DataLossError("a value is not finite");
    }
    values.assign(view.begin(), view.end());
    return absl::OkStatus();
  };
  FP_RETURN_IF_ERROR(rgb(r.indirect_half[0], "indirect A"));
  FP_RETURN_IF_ERROR(rgb(r.indirect_half[1], "indirect B"));
  FP_RETURN_IF_ERROR(rgb(r.albedo, "albedo"));
  if (direct == 1) {
    FP_RETURN_IF_ERROR(rgb(r.direct_half[0], "direct A"));
    FP_RETURN_IF_ERROR(rgb(r.direct_half[1], "direct B"));
  }
  FP_RETURN_IF_ERROR(in.ExpectEnd());
  return r;
}

absl::StatusOr<SparseReference> TraceSparseReference(
    const SparseFrame& frame, std::span<const PixelPosition> pixels,
    const SparseReferenceOptions& options, Executor& executor,
    const std::function<void(std::string_view)>& progress) {
  if (pixels.empty()) return absl::InvalidArgumentError("a reference needs at least one pixel");
  for (const PixelPosition& p : pixels) {
    if (frame.film.crop.Contains(p.x, p.y)) continue;
    return absl::InvalidArgumentError(
        absl::StrFormat("pixel (%d, %d) lies outside of the film's crop", p.x, p.y));
  }
  const Digest key = KeyOf(frame, pixels, options);
  std::string path;
  std::optional<SparseReference> kept;
  if (!options.cache_dir.empty()) {
    std::error_code error;
    std::filesystem::create_directories(options.cache_dir, error);
    if (error) {
      return absl::InvalidArgumentError(options.cache_dir + ": cannot be made: " + error.message() +
                                        "; name another --reference-dir");
    }
    path = (std::filesystem::path(options.cache_dir) /
            (options.label + "-" + key.Hex().substr(0, 16) + ".ref"))
               .string();
    if (std::filesystem::exists(path, error)) {
      FP_ASSIGN_OR_RETURN(const Blob blob, ReadFile(path, size_t{1} << 32));
      absl::StatusOr<SparseReference> read =
          DecodeSparseReference(blob.bytes(), key, pixels.size());
      if (!read.ok()) return Annotate(read.status(), path + " is damaged, remove it");
      kept = *std::move(read);
    }
  }

  const PixelTracer tracer(frame, executor);
  SparseReference reference;
  const auto trace_round = [&](uint32_t paths, uint32_t round, SparseReference& out,
                               double& seconds) -> absl::Status {
    seconds = 0;
    for (int half = 0; half < 2; ++half) {
      double said = 0;
      const auto part = [&](double done) {
        if (done < said + 0.5) return;
        said = done;
        progress(absl::StrFormat("%s: %d pixels, 2 x %d paths, round %d: %.0f %%", options.label,
                                 pixels.size(), paths, round + 1, 50 * (half + done)));
      };
      const uint64_t seed = HashKey(options.seed, kKeyRound, round, static_cast<uint64_t>(half));
      FP_ASSIGN_OR_RETURN(const PixelTracer::Pass pass,
                          tracer.Render(pixels, IndirectSettings(paths, seed), part));
      Store(pass, pixels, half, out);
      seconds += pass.seconds;
    }
    return absl::OkStatus();
  };
  double spent = 0, last = 0;
  bool changed = false;
  if (kept) {
    reference = *std::move(kept);
    reference.from_cache = true;
    last = reference.seconds / reference.rounds;
  } else {
    FP_ASSIGN_OR_RETURN(const uint32_t paths, Pilot(tracer, pixels, options));
    FP_RETURN_IF_ERROR(trace_round(paths, 0, reference, last));
    reference.paths = paths;
    reference.rounds = 1;
    reference.seconds = spent = last;
    if (options.direct_samples > 0) {
      FP_RETURN_IF_ERROR(TraceDirect(tracer, pixels, options, reference));
    }
    FP_RETURN_IF_ERROR(PutInCache(path, reference, key));
  }
  while (reference.IndirectNoise() > options.noise && spent + last <= options.budget_s) {
    SparseReference round;
    FP_RETURN_IF_ERROR(trace_round(reference.paths, reference.rounds, round, last));
    Average(round, reference);
    ++reference.rounds;
    reference.seconds += last;
    reference.from_cache = false;
    spent += last;
    changed = true;
  }
  if (changed) FP_RETURN_IF_ERROR(PutInCache(path, reference, key));
  return reference;
}

}  // namespace farpoint
