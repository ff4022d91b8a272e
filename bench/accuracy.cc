#include "bench/accuracy.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <filesystem>
#include <fstream>
#include <memory>
#include <utility>

#include "absl/strings/str_format.h"
#include "bench/accuracy_checks.h"
#include "bench/accuracy_frame.h"
#include "bench/accuracy_pictures.h"
#include "bench/machine.h"
#include "bench/sparse_reference.h"
#include "bench/text.h"
#include "core/base/executor.h"
#include "core/image/compare.h"
#include "core/image/exr_io.h"

namespace farpoint {

namespace {

constexpr std::array<std::string_view, 6> kChecks = {
    "seams-cornell", "seams-sponza", "leak-room", "leak-wall", "flicker-pan", "flicker-light"};
constexpr uint64_t kPixelSeed = 20130715;
// No seed that a user is likely to render with.
constexpr uint64_t kReferenceSeed = 0x9e3779b97f4a7c15ull;
constexpr double kNoisePart = 1.0 / 3.0;  // of the bar
constexpr int kPictureWidth = 640;
constexpr float kInvPiF = 0.31830988618f;

// The truth at some pixels, wherever it comes from.
struct Truth {
  std::vector<PixelPosition> pixels;  // those that count
  std::vector<Rgb> indirect, direct;  // irradiance, W/m²
  std::vector<Rgb> albedo;
  double noise = 0;         // of indirect
  double beauty_noise = 0;  // of the reflected light
  std::string text;
  double seconds = 0;
};

Rgb Reflected(const Rgb& albedo, const Rgb& irradiance) { return albedo * irradiance * kInvPiF; }

// A number in the first line of a file; nothing if there is none.
std::optional<double> ReadNumber(const std::string& path) {
  std::ifstream file(path);
  double value = 0;
  if (!(file >> value) || !(value >= 0)) return std::nullopt;
  return value;
}

absl::StatusOr<ExrImage> ReadPublished(const std::string& path, const FilmSpec& film) {
  FP_ASSIGN_OR_RETURN(ExrImage image, ReadExr(path));
  if (image.data_window != film.frame() || !image.Find("R") || !image.Find("G") ||
      !image.Find("B")) {
    return absl::InvalidArgumentError(Concat(
        {path, absl::StrFormat(": need R, G and B of %dx%d pixels", film.width, film.height)}));
  }
  return image;
}

Rgb PixelOf(const ExrImage& image, size_t at) {
  return {image.Find("R")->values[at], image.Find("G")->values[at], image.Find("B")->values[at]};
}

bool IsBackground(const Film& film, int x, int y) {
  return !std::isfinite(film.Get(Layer::kDepth, 0, x, y));
}

// What is published beside cornell.gltf: irradiance, a mask, the standard error over the mean.
absl::StatusOr<Truth> PublishedTruth(const std::string& folder, const FilmSpec& film,
                                     const Film& rendered) {
  const std::filesystem::path dir = folder;
  FP_ASSIGN_OR_RETURN(const ExrImage indirect,
                      ReadPublished((dir / "cornell_256_reference_Eind.exr").string(), film));
  FP_ASSIGN_OR_RETURN(const ExrImage direct,
                      ReadPublished((dir / "cornell_256_reference_Edir.exr").string(), film));
  const std::string mask_path = (dir / "cornell_256_mask.npy").string();
  FP_ASSIGN_OR_RETURN(const PixelMask mask, ReadMask(mask_path));
  if (mask.rect != film.frame()) {
    return absl::InvalidArgumentError(mask_path + ": has another size than the frame");
  }
  Truth truth;
  for (int y = 0; y < film.height; ++y) {
    for (int x = 0; x < film.width; ++x) {
      const size_t at =
          static_cast<size_t>(y) * static_cast<size_t>(film.width) + static_cast<size_t>(x);
      if (mask.on[at] == 0 || IsBackground(rendered, x, y)) continue;
      truth.pixels.push_back({x, y});
      truth.indirect.push_back(PixelOf(indirect, at));
      truth.direct.push_back(PixelOf(direct, at));
    }
  }
  truth.albedo = ValuesAt(rendered, Layer::kAlbedo, truth.pixels);
  const std::optional<double> noise = ReadNumber((dir / "noise").string());
  const std::optional<double> direct_noise = ReadNumber((dir / "noise_direct").string());
  truth.noise = noise.value_or(0.0);
  // The two are independent; each counts by its share of the reflected light.
  double ei = 0, ed = 0;
  for (size_t i = 0; i < truth.pixels.size(); ++i) {
    for (int c = 0; c < 3; ++c) {
      ei += static_cast<double>(truth.indirect[i][c]);
      ed += static_cast<double>(truth.direct[i][c]);
    }
  }
  if (ei + ed > 0) {
    truth.beauty_noise = std::hypot(truth.noise * ei, direct_noise.value_or(0.0) * ed) / (ei + ed);
  }
  truth.text = absl::StrFormat("published, whole frame, noise %s",
                               noise ? absl::StrFormat("%.4f", *noise) : std::string("not stated"));
  return truth;
}

// E = pi rho L from the walls' reflected light, pi L straight from them: all of the sphere is wall.
absl::StatusOr<Truth> FurnaceTruth(const Scene& scene, const Film& rendered) {
  if (scene.materials.size() != 1) {
    return absl::InternalError("the furnace has one material; this is a defect of farpoint");
  }
  const Rgb radiance = scene.materials.front().emission;
  const Rgb albedo = scene.materials.front().base_color;
  constexpr float kPiF = 3.14159265358979f;
  Truth truth;
  const PixelRect& rect = rendered.rect();
  for (int y = rect.y0; y < rect.y1; ++y) {
    for (int x = rect.x0; x < rect.x1; ++x) {
      if (!IsBackground(rendered, x, y)) truth.pixels.push_back({x, y});
    }
  }
  truth.direct.assign(truth.pixels.size(), radiance * kPiF);
  truth.indirect.assign(truth.pixels.size(), radiance * albedo * kPiF);
  truth.albedo.assign(truth.pixels.size(), albedo);
  truth.text = "closed form, whole frame";
  return truth;
}

Truth TruthOf(const SparseReference& reference, std::span<const PixelPosition> pixels) {
  Truth truth;
  double variance = 0, sum = 0, n = 0;
  for (size_t i = 0; i < pixels.size(); ++i) {
    if (!reference.hit[i]) continue;
    truth.pixels.push_back(pixels[i]);
    truth.indirect.push_back(reference.Indirect(i));
    truth.direct.push_back(reference.Direct(i));
    truth.albedo.push_back(reference.albedo[i]);
    // Of the sum of both lights, by their halves: their errors are independent.
    const Rgb a = reference.indirect_half[0][i] + reference.direct_half[0][i];
    const Rgb b = reference.indirect_half[1][i] + reference.direct_half[1][i];
    for (int c = 0; c < 3; ++c) {
      const double scale = static_cast<double>(reference.albedo[i][c] * kInvPiF);
      const double error = 0.5 * scale * static_cast<double>(a[c] - b[c]);
      variance += error * error;
      sum += 0.5 * scale * static_cast<double>(a[c] + b[c]);
      n += 1;
    }
  }
  truth.noise = reference.IndirectNoise();
  if (sum > 0) truth.beauty_noise = std::sqrt(variance * n) / sum;
  truth.text = absl::StrFormat("pt, %d of the pixels, 2 × %d × %d paths, noise %.4f%s",
                               truth.pixels.size(), reference.rounds, reference.paths, truth.noise,
                               reference.from_cache ? ", kept from an earlier run" : "");
  truth.seconds = reference.seconds;
  return truth;
}

std::vector<float> RelativeErrors(const std::vector<Rgb>& image, const Truth& truth, double mean) {
  std::vector<float> errors;
  for (size_t i = 0; i < image.size(); ++i) {
    const Rgb d = image[i] - truth.indirect[i];
    errors.push_back((d.x + d.y + d.z) / (3.0f * static_cast<float>(mean)));
  }
  return errors;
}

void AddPicture(const std::string& what, std::string title, std::string caption, Picture full,
                AccuracyResult& result) {
  AccuracyPicture out;
  out.title = std::move(title);
  out.caption = std::move(caption);
  if (full.width > kPictureWidth) Append(out.caption, {"; shown at half size"});
  Picture picture = ShrunkTo(std::move(full), kPictureWidth);
  out.file = Concat({result.c.name, "-", what, ".png"});
  out.width = picture.width;
  out.height = picture.height;
  out.rgb = std::move(picture.rgb);
  result.pictures.push_back(std::move(out));
}

void AddPictures(const Film& film, const Truth& truth, const std::vector<Rgb>& image,
                 AccuracyResult& result) {
  const float beauty_white = LuminanceQuantile(film, Layer::kBeauty, 0.97);
  const float white = LuminanceQuantile(film, Layer::kIrradiance, 0.99);
  if (!(beauty_white > 0) || !(white > 0)) return;
  AddPicture("beauty", "Beauty", absl::StrFormat("white is %.3g W/(m² sr)", beauty_white),
             ColourPicture(film, Layer::kBeauty, beauty_white), result);
  AddPicture("irradiance", "Indirect irradiance", absl::StrFormat("white is %.3g W/m²", white),
             ColourPicture(film, Layer::kIrradiance, white), result);
  AddPicture("false", "Its luminance in false colour",
             absl::StrFormat("black 0, violet, red, yellow, white %.3g W/m²", white),
             FalseColourPicture(film, Layer::kIrradiance, white), result);
  const std::vector<float> errors = RelativeErrors(image, truth, result.indirect.mean);
  const float scale = static_cast<float>(3 * result.c.rr_bar);
  AddPicture(
      "error", "Error of the indirect irradiance",
      absl::StrFormat("at %d pixels; blue %.3g of the mean too little, white right, red as much "
                      "too much",
                      errors.size(), scale),
      ErrorPicture(film, Layer::kIrradiance, white, truth.pixels, errors, scale), result);
}

class Runner {
 public:
  Runner(const AccuracyOptions& options, const std::function<void(std::string_view)>& progress,
         AccuracyReport& report)
      : options_(options), progress_(progress), report_(report), executor_(options.threads) {
    report_.threads = executor_.threads();
  }

  absl::Status RunCase(const AccuracyCase& c) {
    progress_(Concat({c.name, ": loading and baking"}));
    std::string missing;
    FP_ASSIGN_OR_RETURN(std::optional<AccuracyScene> source,
                        LoadAccuracyScene(c, options_.folders, options_.quick, missing));
    if (!source) {
      report_.left_out.push_back({c.name, missing});
      return absl::OkStatus();
    }
    AccuracyResult result;
    result.c = c;
    result.notes = source->notes;
    RenderSettings settings = MeasuredSettings(options_);
    FP_ASSIGN_OR_RETURN(LoadedFrame loaded, LoadFrame(source->scene, source->camera, c.width,
                                                      c.height, settings, &bake_cache_, executor_));
    result.triangles = loaded.bake.counts["triangles"];
    result.surfels = loaded.bake.counts["surfels"];
    result.bake_s = BakeSeconds(loaded.bake);

    progress_(Concat({c.name, ": rendering"}));
    settings.layers = {Layer::kBeauty, Layer::kAlbedo, Layer::kDepth, Layer::kIrradiance,
                       Layer::kDirectIrradiance};
    FP_ASSIGN_OR_RETURN(RenderedFrame rendered, RenderByTiles(loaded.frame, settings, executor_));
    const double receivers = static_cast<double>(rendered.stats.counts["receivers"]);
    result.receivers = rendered.stats.counts["receivers"];
    result.records = rendered.stats.counts["clusters"];
    if (receivers > 0) {
      result.us_per_receiver = 1e6 * GatherSeconds(rendered.stats) / receivers;
      // Rays, with those of refined strata; a gather by cuts has none, only strata.
      const uint64_t rays = rendered.stats.counts["gather_rays"];
      result.samples_per_pixel =
          static_cast<double>(rays > 0 ? rays : rendered.stats.counts["cluster_samples"]) /
          receivers;
    }

    FP_ASSIGN_OR_RETURN(const Truth truth, MakeTruth(c, source->scene, loaded, rendered.film));
    result.truth = truth.text;
    result.truth_seconds = truth.seconds;
    const std::vector<Rgb> image = ValuesAt(rendered.film, Layer::kIrradiance, truth.pixels);
    result.indirect = CompareSparse(image, truth.indirect, truth.noise);
    if (result.indirect.pixels == 0 || !(result.indirect.mean > 0)) {
      return absl::InvalidArgumentError(
          c.name + ": no indirect light where the truth is known, so errors have no scale");
    }
    const std::vector<Rgb> direct = ValuesAt(rendered.film, Layer::kDirectIrradiance, truth.pixels);
    std::vector<Rgb> seen, true_seen;
    for (size_t i = 0; i < image.size(); ++i) {
      seen.push_back(Reflected(truth.albedo[i], image[i] + direct[i]));
      true_seen.push_back(Reflected(truth.albedo[i], truth.indirect[i] + truth.direct[i]));
    }
    result.beauty = CompareSparse(seen, true_seen, truth.beauty_noise);
    result.verdict = VerdictOf(c, result.indirect);
    if (options_.pictures) AddPictures(rendered.film, truth, image, result);
    progress_(absl::StrFormat("%s: rr %.4f ± %.4f (bar %.3f), bias %+.4f, %.1f us/receiver, %s",
                              c.name, result.indirect.rr, result.indirect.rr_error, c.rr_bar,
                              result.indirect.bias, result.us_per_receiver,
                              NameOf(result.verdict)));
    report_.results.push_back(std::move(result));
    return absl::OkStatus();
  }

  absl::Status RunCheck(std::string_view name) {
    progress_(Concat({name, ": started"}));
    const AccuracyContext context{options_, executor_, bake_cache_, progress_};
    if (name.starts_with("seams")) {
      std::string missing;
      FP_ASSIGN_OR_RETURN(std::optional<AccuracyCheck> check, CheckSeams(name, context, missing));
      if (check) {
        report_.checks.push_back(*std::move(check));
      } else {
        report_.left_out.push_back({std::string(name), missing});
      }
      return absl::OkStatus();
    }
    FP_ASSIGN_OR_RETURN(report_.checks.emplace_back(), name.starts_with("leak")
                                                           ? CheckLeak(name, context)
                                                           : CheckFlicker(name, context));
    return absl::OkStatus();
  }

 private:
  absl::StatusOr<Truth> MakeTruth(const AccuracyCase& c, const Scene& scene,
                                  const LoadedFrame& loaded, const Film& rendered) {
    switch (c.truth) {
      case TruthKind::kPublished:
        return PublishedTruth(options_.folders.references, loaded.frame.film, rendered);
      case TruthKind::kFurnace:
        return FurnaceTruth(scene, rendered);
      case TruthKind::kTraced:
        break;
    }
    const std::vector<PixelPosition> pixels =
        StratifiedPixels(loaded.frame.film.crop, options_.reference_pixels, kPixelSeed);
    SparseReferenceOptions reference;
    reference.noise = c.rr_bar * kNoisePart;
    reference.budget_s = options_.reference_budget_s;
    reference.direct_samples = options_.quick ? 64 : 1024;
    reference.seed = kReferenceSeed;
    reference.cache_dir = options_.reference_dir;
    reference.label = c.name;
    FP_ASSIGN_OR_RETURN(
        const SparseReference traced,
        TraceSparseReference(loaded.frame, pixels, reference, executor_, progress_));
    return TruthOf(traced, pixels);
  }

  const AccuracyOptions& options_;
  const std::function<void(std::string_view)>& progress_;
  AccuracyReport& report_;
  Executor executor_;
  // Cases that differ in light or camera only share what does not depend on them.
  BakeCache bake_cache_{size_t{2} << 30};
};

}  // namespace

ErrorFigures CompareSparse(std::span<const Rgb> image, std::span<const Rgb> truth, double noise) {
  ErrorFigures out;
  if (image.empty() || image.size() != truth.size()) return out;
  const double n = static_cast<double>(image.size());
  double mean = 0;
  for (const Rgb& t : truth) {
    mean += (static_cast<double>(t.x) + static_cast<double>(t.y) + static_cast<double>(t.z)) / 3;
  }
  mean /= n;
  if (!(mean > 0)) return out;
  // By pixel, so that the spread over pixels tells what their choice adds.
  double sum = 0, sum2 = 0, square = 0, square2 = 0, max = 0;
  for (size_t i = 0; i < image.size(); ++i) {
    double d = 0, d2 = 0;
    for (int c = 0; c < 3; ++c) {
      const double e = static_cast<double>(image[i][c]) - static_cast<double>(truth[i][c]);
      d += e / 3;
      d2 += e * e / 3;
      max = std::max(max, std::fabs(e));
    }
    sum += d;
    sum2 += d * d;
    square += d2;
    square2 += d2 * d2;
  }
  const auto deviation = [&](double s, double s2) {
    return n > 1 ? std::sqrt(std::max(0.0, s2 / n - (s / n) * (s / n)) / (n - 1)) : 0.0;
  };
  out.pixels = image.size();
  out.mean = mean;
  out.noise = noise;
  out.rel_rmse = std::sqrt(square / n) / mean;
  out.rr = std::sqrt(std::max(0.0, out.rel_rmse * out.rel_rmse - noise * noise));
  // d sqrt(v) = dv / (2 sqrt(v))
  const double rr_or = std::max(out.rr, 1e-12);
  out.rr_error = deviation(square, square2) / (mean * mean) / (2 * rr_or);
  out.bias = sum / n / mean;
  out.bias_error = deviation(sum, sum2) / mean;
  out.max = max / mean;
  return out;
}

std::string_view NameOf(Verdict verdict) {
  switch (verdict) {
    case Verdict::kHolds:
      return "holds";
    case Verdict::kFails:
      return "FAILS";
    case Verdict::kNoisy:
      return "noisy reference";
  }
  return "unknown";
}

Verdict AccuracyCheck::verdict() const {
  for (const CheckValue& v : values) {
    if (v.bar > 0 && !(v.value <= v.bar)) return Verdict::kFails;
  }
  return Verdict::kHolds;
}

Verdict VerdictOf(const AccuracyCase& c, const ErrorFigures& indirect) {
  if (indirect.rr > c.rr_bar || std::fabs(indirect.bias) > c.bias_bar) return Verdict::kFails;
  return indirect.noise > c.rr_bar * kNoisePart ? Verdict::kNoisy : Verdict::kHolds;
}

std::vector<std::string> AccuracyNames(bool quick) {
  std::vector<std::string> names;
  for (const AccuracyCase& c : AccuracyCases(quick)) names.push_back(c.name);
  for (const std::string_view check : kChecks) names.emplace_back(check);
  return names;
}

absl::StatusOr<AccuracyReport> RunAccuracy(const AccuracyOptions& asked,
                                           const std::function<void(std::string_view)>& progress) {
  AccuracyReport report;
  report.options = asked;
  AccuracyOptions& options = report.options;
  if (options.quick) {
    if (options.points == 0) options.points = 20'000;
    options.reference_pixels = std::min<size_t>(options.reference_pixels, 100);
  }
  FP_RETURN_IF_ERROR(ValidateSettings(MeasuredSettings(options)));
  if (options.cases.empty()) options.cases = AccuracyNames(options.quick);
  // Names first: a mistake should not cost the time of a bake.
  const std::vector<std::string> known = AccuracyNames(options.quick);
  for (const std::string& name : options.cases) {
    if (std::find(known.begin(), known.end(), name) == known.end()) {
      std::string names;
      for (const std::string& k : known) Append(names, {names.empty() ? "" : ", ", k});
      return absl::InvalidArgumentError(Concat({"--case ", name, " is none of ", names}));
    }
  }
  report.date_utc = DateUtc();
  report.cpu = CpuModel();
  report.load_average_start = LoadAverage();
  Runner runner(options, progress, report);
  for (const std::string& name : options.cases) {
    if (std::find(kChecks.begin(), kChecks.end(), name) != kChecks.end()) {
      FP_RETURN_IF_ERROR(runner.RunCheck(name));
      continue;
    }
    FP_ASSIGN_OR_RETURN(const AccuracyCase c, FindAccuracyCase(name, options.quick));
    FP_RETURN_IF_ERROR(runner.RunCase(c));
  }
  report.load_average_end = LoadAverage();
  return report;
}

}  // namespace farpoint
