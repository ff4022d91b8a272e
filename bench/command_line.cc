#include "bench/command_line.h"

#include <CLI/CLI.hpp>
#include <algorithm>
#include <array>
#include <charconv>
#include <string_view>

#include "bench/text.h"

namespace farpoint {

namespace {

constexpr std::array<std::string_view, 5> kNotBuilt = {"paper", "scale", "stability", "skip",
                                                       "service"};

// "1280x1000". Sizes are checked by ValidateFilm.
bool ParseResolution(std::string_view text, int& width, int& height) {
  const char* const end = text.data() + text.size();
  const auto [x, x_error] = std::from_chars(text.data(), end, width);
  if (x_error != std::errc() || x == end || *x != 'x') return false;
  const auto [y, y_error] = std::from_chars(x + 1, end, height);
  return y_error == std::errc() && y == end && width > 0 && height > 0;
}

void AddCommonOptions(CLI::App& app, std::string& output_dir, bool& quick) {
  app.add_option("-o,--output", output_dir, "Folder of the results; made if it is not there")
      ->capture_default_str();
  app.add_flag("--quick", quick, "Small and few: a check that all works, not a measurement");
}

}  // namespace

absl::StatusOr<BenchCommandLine> ParseBenchCommandLine(std::vector<std::string> args) {
  BenchCommandLine line;
  line.output_dir = "out/bench";
  if (!args.empty() &&
      std::find(kNotBuilt.begin(), kNotBuilt.end(), args.front()) != kNotBuilt.end()) {
    return absl::UnimplementedError("'" + args.front() + "' is not built yet; use pareto or micro");
  }
  CLI::App app("Measures farpoint: docs/benchmarks.md explains what comes out.", "farpoint-bench");
  app.set_version_flag("--version", std::string("farpoint-bench ") + FARPOINT_VERSION);
  app.require_subcommand(1);

  ParetoOptions& p = line.pareto;
  std::string resolution;
  double noise = 0;
  CLI::App* pareto = app.add_subcommand(
      "pareto", "Time against error of all integrators; writes pareto.json and pareto.html");
  AddCommonOptions(*pareto, line.output_dir, p.quick);
  pareto->add_option("--scene", p.scene, "cornell, city, furnace or a glTF file")
      ->capture_default_str();
  CLI::Option* resolution_option =
      pareto->add_option("--resolution", resolution,
                         "WxH in pixels [the reference's; without one 256x256, quick: 64x64]");
  CLI::Option* reference =
      pareto->add_option("--reference", p.reference_path,
                         "EXR with the true irradiance at pixel centres [one is path-traced]");
  pareto->add_option("--ref-layer", p.ref_layer, "Its layer [irradiance, else R, G, B]")
      ->needs(reference);
  CLI::Option* noise_option =
      pareto->add_option("--noise", noise, "Its standard error over its mean [unknown, taken as 0]")
          ->needs(reference)
          ->check(CLI::Range(0.0, 10.0));
  pareto->add_option("--mask", p.mask_path, "EXR or .npy of the pixels that count [all that hit]");
  pareto
      ->add_option("--reference-paths", p.reference_paths,
                   "Paths per pixel of the traced reference [8192, quick: 2048]")
      ->excludes(reference)
      ->check(CLI::Range(8u, 1u << 20));
  pareto->add_option("--points", p.points, "Surfels [by the scene, quick: 20000]")
      ->check(CLI::Range(uint64_t{1}, uint64_t{1} << 31));
  pareto->add_option("--light-samples", p.light_samples, "Shadow rays, as of farpoint render")
      ->capture_default_str()
      ->check(CLI::Range(1, 4096));
  pareto->add_option("--seed", p.seed, "Of every random choice")->capture_default_str();
  pareto->add_option("--repeat", p.repeat, "Renders of each configuration [3, quick: 1]")
      ->check(CLI::Range(1, 1000));
  pareto->add_option("--threads", p.threads, "0: all cores; 1 disturbs the times least")
      ->capture_default_str()
      ->check(CLI::Range(0, 1024));

  CLI::App* micro = app.add_subcommand("micro", "The kernels one by one; writes micro.json");
  AddCommonOptions(*micro, line.output_dir, line.micro.quick);
  micro->add_option("--filter", line.micro.filter, "Only names that match this regular expression");

  // CLI11 takes the arguments from the back.
  std::reverse(args.begin(), args.end());
  try {
    app.parse(args);
  } catch (const CLI::CallForHelp&) {
    const CLI::App* asked = pareto->parsed() ? pareto : micro->parsed() ? micro : &app;
    line.print = asked->help(asked == &app ? "" : "farpoint-bench");
    return line;
  } catch (const CLI::CallForVersion& version) {
    line.print = std::string(version.what()) + "\n";
    return line;
  } catch (const CLI::ParseError& error) {
    return absl::InvalidArgumentError(std::string(error.what()) + "; see farpoint-bench --help");
  }
  line.verb = pareto->parsed() ? BenchVerb::kPareto : BenchVerb::kMicro;
  if (resolution_option->count() > 0 && !ParseResolution(resolution, p.width, p.height)) {
    return absl::InvalidArgumentError("--resolution " + resolution +
                                      " is not WIDTHxHEIGHT in pixels, such as 640x480");
  }
  if (noise_option->count() > 0) p.noise = noise;
  if (line.output_dir.empty()) return absl::InvalidArgumentError("-o needs the name of a folder");
  return line;
}

}  // namespace farpoint
