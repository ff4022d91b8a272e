#include <algorithm>
#include <cmath>
#include <map>
#include <tuple>
#include <utility>

#include "absl/strings/str_format.h"
#include "bench/accuracy_checks.h"
#include "bench/accuracy_frame.h"
#include "bench/accuracy_pictures.h"
#include "bench/text.h"
#include "core/math/sampling.h"

namespace farpoint {

namespace {

constexpr double kBar = 0.01;          // of the local value
constexpr float kLeastCos = 0.99905f;  // 2.5 degrees
constexpr float kOffPlane = 0.05f;     // of the distance
constexpr float kDepthStep = 0.1f;     // of the depth
constexpr float kLeastValue = 0.05f;   // of the frame's mean irradiance
constexpr uint64_t kReferenceSeed = 0x5ea3b0adull;
constexpr double kReferenceNoise = 0.008;
constexpr int kRun = 32;                          // pairs along a border
constexpr size_t kPairs = 400, kQuickPairs = 30;  // of each kind, with pt

Vec3f Vec3At(const Film& film, Layer layer, int x, int y) {
  return {film.Get(layer, 0, x, y), film.Get(layer, 1, x, y), film.Get(layer, 2, x, y)};
}

float ValueAt(const Film& film, int x, int y) {
  return Luminance(Vec3At(film, Layer::kIrradiance, x, y));
}

bool AreSmooth(const Film& film, int x0, int y0, int x1, int y1) {
  const float z0 = film.Get(Layer::kDepth, 0, x0, y0), z1 = film.Get(Layer::kDepth, 0, x1, y1);
  if (!std::isfinite(z0) || !std::isfinite(z1)) return false;
  if (std::fabs(z1 - z0) > kDepthStep * std::min(z0, z1)) return false;
  const Vec3f n0 = Vec3At(film, Layer::kNormal, x0, y0), n1 = Vec3At(film, Layer::kNormal, x1, y1);
  if (Dot(n0, n1) < kLeastCos) return false;
  const Vec3f d = Vec3At(film, Layer::kPosition, x1, y1) - Vec3At(film, Layer::kPosition, x0, y0);
  const float off = kOffPlane * std::sqrt(Length2(d));
  return std::fabs(Dot(d, n0)) <= off && std::fabs(Dot(d, n1)) <= off;
}

struct Mean {
  double sum = 0, sum2 = 0;
  size_t n = 0;
  void Add(double v) {
    sum += v;
    sum2 += v * v;
    ++n;
  }
  double mean() const { return n > 0 ? sum / static_cast<double>(n) : 0; }
  // Variance of the mean.
  double variance() const {
    if (n < 2) return 0;
    const double m = mean(), count = static_cast<double>(n);
    return std::max(0.0, sum2 / count - m * m) / (count - 1);
  }
};

PixelPosition FirstOf(const PixelPair& p) {
  return p.vertical ? PixelPosition{p.x, p.y - 1} : PixelPosition{p.x - 1, p.y};
}

int BorderAt(const PixelPair& p) { return p.vertical ? p.y : p.x; }

bool CrossesClusters(const Film& film, const PixelPair& p) {
  const PixelPosition first = FirstOf(p);
  return film.Get(Layer::kCluster, 0, p.x, p.y) != film.Get(Layer::kCluster, 0, first.x, first.y);
}

// `count` of them, by the hash of their place.
std::vector<PixelPair> SomeOf(std::vector<PixelPair> pairs, size_t count) {
  const auto key = [](const PixelPair& p) {
    return HashKey(kReferenceSeed, static_cast<uint64_t>(p.x), static_cast<uint64_t>(p.y),
                   static_cast<uint64_t>(p.vertical));
  };
  std::sort(pairs.begin(), pairs.end(),
            [&](const PixelPair& a, const PixelPair& b) { return key(a) < key(b); });
  if (pairs.size() > count) pairs.resize(count);
  return pairs;
}

// Mean of |step - true step| over the true local value.
Mean StepErrors(const Film& film, std::span<const PixelPair> pairs, std::span<const Rgb> truth,
                double least) {
  Mean mean;
  for (size_t i = 0; i < pairs.size(); ++i) {
    const PixelPosition first = FirstOf(pairs[i]);
    const double t0 = static_cast<double>(Luminance(truth[2 * i]));
    const double t1 = static_cast<double>(Luminance(truth[2 * i + 1]));
    const double step = static_cast<double>(ValueAt(film, pairs[i].x, pairs[i].y)) -
                        static_cast<double>(ValueAt(film, first.x, first.y));
    mean.Add(std::fabs(step - (t1 - t0)) / std::max(least, 0.5 * (t0 + t1)));
  }
  return mean;
}

struct Setting {
  AccuracyCase frame;
  PixelRect shown;  // of the picture at threefold contrast
  int times = 1;
  std::string what;
};

absl::StatusOr<Setting> SettingOf(std::string_view name, bool quick) {
  Setting s;
  if (name == "seams-cornell") {
    s.frame.scene = "cornell";
    s.frame.width = s.frame.height = quick ? 64 : 256;
    s.shown = {0, 0, s.frame.width, s.frame.height};
    s.times = 2;
    s.what = "the walls";
    return s;
  }
  FP_ASSIGN_OR_RETURN(s.frame, FindAccuracyCase("sponza-sun", false));
  s.shown = {0, 340, 640, 500};
  s.what = "the floor";
  return s;
}

}  // namespace

std::vector<PixelPair> SmoothPairs(const Film& film) {
  const PixelRect& r = film.rect();
  double sum = 0, n = 0;
  for (int y = r.y0; y < r.y1; ++y) {
    for (int x = r.x0; x < r.x1; ++x) {
      if (!std::isfinite(film.Get(Layer::kDepth, 0, x, y))) continue;
      sum += static_cast<double>(ValueAt(film, x, y));
      n += 1;
    }
  }
  std::vector<PixelPair> pairs;
  if (!(sum > 0)) return pairs;
  const float least = kLeastValue * static_cast<float>(sum / n);
  for (const bool vertical : {false, true}) {
    const int dx = vertical ? 0 : 1, dy = vertical ? 1 : 0;
    for (int y = r.y0 + 2 * dy; y < r.y1 - dy; ++y) {
      for (int x = r.x0 + 2 * dx; x < r.x1 - dx; ++x) {
        bool smooth = true;
        for (int k = -2; k <= 1 && smooth; ++k) {
          smooth = ValueAt(film, x + k * dx, y + k * dy) >= least;
        }
        for (int k = -2; k <= 0 && smooth; ++k) {
          smooth = AreSmooth(film, x + k * dx, y + k * dy, x + (k + 1) * dx, y + (k + 1) * dy);
        }
        if (smooth) pairs.push_back({x, y, vertical});
      }
    }
  }
  return pairs;
}

double JumpOf(const Film& film, const PixelPair& p) {
  const int dx = p.vertical ? 0 : 1, dy = p.vertical ? 1 : 0;
  double e[4];
  for (int k = 0; k < 4; ++k) {
    e[k] = static_cast<double>(ValueAt(film, p.x + (k - 2) * dx, p.y + (k - 2) * dy));
  }
  const double beside = 0.5 * ((e[1] - e[0]) + (e[3] - e[2]));
  return std::fabs(e[2] - e[1] - beside) / (0.5 * (e[1] + e[2]));
}

JumpFigures GridJumps(const Film& film, std::span<const PixelPair> pairs, int period_px) {
  // By direction, line and place on the line.
  std::map<std::tuple<bool, int, int>, double> jumps;
  for (const PixelPair& p : pairs) {
    jumps[{p.vertical, BorderAt(p), p.vertical ? p.x : p.y}] = JumpOf(film, p);
  }
  struct Run {
    double excess = 0, pairs = 0;
  };
  std::map<std::tuple<bool, int, int>, Run> runs;
  JumpFigures out;
  double excess = 0;
  for (const auto& [key, jump] : jumps) {
    const auto& [vertical, line, along] = key;
    if (line % period_px != 0) continue;
    Mean beside;
    for (const int offset : {-5, -4, -3, 3, 4, 5}) {
      const auto at = jumps.find({vertical, line + offset, along});
      if (at != jumps.end()) beside.Add(at->second);
    }
    if (beside.n == 0) continue;
    Run& run = runs[{vertical, line, along / kRun}];
    run.excess += jump - beside.mean();
    run.pairs += 1;
    excess += jump - beside.mean();
    out.jump += jump;
    out.jump_beside += beside.mean();
    ++out.pairs;
  }
  if (out.pairs == 0) return out;
  const double n = static_cast<double>(out.pairs);
  out.jump /= n;
  out.jump_beside /= n;
  double square = 0;
  for (const auto& [key, run] : runs) {
    const double d = run.excess - run.pairs * excess / n;
    square += d * d;
  }
  out.excess_error = std::sqrt(square) / n;
  return out;
}

absl::StatusOr<std::optional<AccuracyCheck>> CheckSeams(std::string_view name,
                                                        const AccuracyContext& context,
                                                        std::string& missing) {
  const AccuracyOptions& options = context.options;
  FP_ASSIGN_OR_RETURN(const Setting setting, SettingOf(name, options.quick));
  FP_ASSIGN_OR_RETURN(const std::optional<AccuracyScene> source,
                      LoadAccuracyScene(setting.frame, options.folders, options.quick, missing));
  if (!source) return std::nullopt;
  RenderSettings settings = MeasuredSettings(options);
  FP_ASSIGN_OR_RETURN(const LoadedFrame loaded,
                      LoadFrame(source->scene, source->camera, setting.frame.width,
                                setting.frame.height, settings, &context.cache, context.executor));
  settings.layers = {Layer::kNormal, Layer::kPosition, Layer::kDepth, Layer::kIrradiance,
                     Layer::kCluster};
  FP_ASSIGN_OR_RETURN(const RenderedFrame rendered,
                      RenderByTiles(loaded.frame, settings, context.executor));
  const Film& film = rendered.film;
  const std::vector<PixelPair> pairs = SmoothPairs(film);

  AccuracyCheck check;
  check.name = name;
  check.setup = Concat({CommandOf(setting.frame),
                        absl::StrFormat("; %d pairs of pixels on smooth surfaces; jumps are parts "
                                        "of the local value",
                                        pairs.size())});
  for (const int period : {8, 32, 128}) {
    const JumpFigures jumps = GridJumps(film, pairs, period);
    if (jumps.pairs == 0) continue;
    check.values.push_back(
        {absl::StrFormat("jump across %d px borders over those beside (%.4f over "
                         "%.4f)",
                         period, jumps.jump, jumps.jump_beside),
         jumps.jump - jumps.jump_beside, jumps.excess_error, kBar});
  }

  std::vector<PixelPair> across, inside;
  for (const PixelPair& p : pairs) {
    if (BorderAt(p) % 8 == 0) continue;
    (CrossesClusters(film, p) ? across : inside).push_back(p);
  }
  const size_t count = options.quick ? kQuickPairs : kPairs;
  across = SomeOf(std::move(across), count);
  inside = SomeOf(std::move(inside), count);
  if (!across.empty() && !inside.empty()) {
    std::vector<PixelPosition> pixels;
    for (const auto* list : {&across, &inside}) {
      for (const PixelPair& p : *list) {
        pixels.push_back(FirstOf(p));
        pixels.push_back({p.x, p.y});
      }
    }
    SparseReferenceOptions reference;
    reference.noise = options.quick ? 0.05 : kReferenceNoise;
    reference.budget_s = options.reference_budget_s;
    reference.direct_samples = 0;
    reference.seed = kReferenceSeed;
    reference.cache_dir = options.reference_dir;
    reference.label = name;
    FP_ASSIGN_OR_RETURN(
        const SparseReference truth,
        TraceSparseReference(loaded.frame, pixels, reference, context.executor, context.progress));
    std::vector<Rgb> means;
    for (size_t i = 0; i < pixels.size(); ++i) means.push_back(truth.Indirect(i));
    const std::span<const Rgb> values = means;
    double mean = 0;
    for (const Rgb& v : values) mean += static_cast<double>(Luminance(v));
    const double least =
        static_cast<double>(kLeastValue) * mean / static_cast<double>(values.size());
    if (!(least > 0)) return absl::InvalidArgumentError(Concat({name, ": its truth is dark"}));
    const Mean border = StepErrors(film, across, values.first(2 * across.size()), least);
    const Mean elsewhere = StepErrors(film, inside, values.subspan(2 * across.size()), least);
    check.values.push_back(
        {absl::StrFormat("step across borders of clusters, less pt's, over that elsewhere (%.4f "
                         "over %.4f, %d and %d pairs, pt's noise %.4f)",
                         border.mean(), elsewhere.mean(), border.n, elsewhere.n,
                         truth.IndirectNoise()),
         border.mean() - elsewhere.mean(), std::sqrt(border.variance() + elsewhere.variance()),
         kBar});
  }
  if (!options.pictures) return check;
  const float white = LuminanceQuantile(film, Layer::kIrradiance, 0.99);
  if (!(white > 0)) return check;
  Film part(setting.shown.Intersect(film.rect()),
            std::vector<Layer>(film.layers().begin(), film.layers().end()));
  part.Paste(film);
  const float middle = LuminanceQuantile(part, Layer::kIrradiance, 0.5);
  if (!(middle > 0)) return check;
  Picture picture = ContrastPicture(part, Layer::kIrradiance, white, middle / white, 3);
  picture = Enlarged(picture, {0, 0, picture.width, picture.height}, setting.times);
  check.pictures.push_back(
      {"Threefold contrast", Concat({setting.what, absl::StrFormat(", grey is %.3g W/m²", middle)}),
       Concat({name, "-contrast.png"}), picture.width, picture.height, std::move(picture.rgb)});
  return check;
}

}  // namespace farpoint
