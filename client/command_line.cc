#include "client/command_line.h"

#include <CLI/CLI.hpp>
#include <algorithm>
#include <charconv>
#include <cmath>
#include <list>
#include <map>
#include <memory>
#include <string_view>

#include "client/nearest_name.h"
#include "core/base/blob.h"

namespace farpoint {
namespace {

constexpr size_t kMaxConfigBytes = 1 << 20;

absl::Status Bad(std::string text) { return absl::InvalidArgumentError(text); }

// "  names    help", the help wrapped to the right of its column.
std::string HelpEntry(const std::string& names, std::string_view help) {
  constexpr size_t kColumn = 28, kWidth = 100;
  std::string text = "  " + names;
  text += names.size() + 4 > kColumn ? "\n" + std::string(kColumn, ' ')
                                     : std::string(kColumn - 2 - names.size(), ' ');
  size_t at = kColumn;
  while (!help.empty()) {
    const std::string_view word = help.substr(0, help.find(' '));
    if (at + word.size() > kWidth && at > kColumn) {
      text.back() = '\n';
      text.append(kColumn, ' ');
      at = kColumn;
    }
    text.append(word).append(" ");
    at += word.size() + 1;
    help.remove_prefix(std::min(help.size(), word.size() + 1));
  }
  text.back() = '\n';
  return text;
}

// Declares the options of one verb and remembers where their values go. Values arrive as text and
// are checked here, so that every message has the same form.
class Options {
 public:
  explicit Options(CLI::App& app) : app_(app) {
    // Help is printed by us, after the whole line was read.
    app_.set_help_flag();
    app_.allow_extras();
    app_.add_flag("-h,--help", help_);
    names_.push_back("--help");
    entries_.push_back({"General", "-h, --help", "print this help"});
  }

  void Text(const std::string& names, const std::string& metavar, std::string& target,
            const std::string& help, const std::string& group) {
    CLI::Option* option = app_.add_option(names, target);
    option->take_last();
    names_.push_back("--" + option->get_lnames().front());
    const size_t comma = names.find(',');
    entries_.push_back(
        {group,
         (comma == std::string::npos ? names
                                     : names.substr(0, comma) + ", " + names.substr(comma + 1)) +
             " " + metavar,
         help});
  }

  void Flag(const std::string& name, bool& target, const std::string& help,
            const std::string& group) {
    app_.add_flag(name, target);
    names_.push_back(name);
    switches_.push_back(name);
    entries_.push_back({group, name, help});
  }

  template <typename T>
  void Number(const std::string& name, const std::string& metavar, std::optional<T>& target, T min,
              T max, const std::string& help, const std::string& group) {
    std::string& text = texts_.emplace_back();
    Text(name, metavar, text, help, group);
    CLI::Option* option = app_.get_option(name);
    checks_.push_back([=, &text, &target]() -> absl::Status {
      if (option->count() == 0) return absl::OkStatus();
      T value{};
      const char* end = text.data() + text.size();
      const auto result = std::from_chars(text.data(), end, value);
      if (result.ec != std::errc() || result.ptr != end || !(value >= min) || !(value <= max)) {
        std::ostringstream message;
        message << name << " " << text << ": expected a "
                << (std::is_integral_v<T> ? "whole number" : "number") << " from " << min << " to "
                << max;
        return Bad(message.str());
      }
      target = value;
      return absl::OkStatus();
    });
  }

  void Positional(const std::string& name, std::string& target, const std::string& help) {
    app_.add_option(name, target);
    entries_.push_back({"", name, help});
  }

  void Render(std::vector<GivenFlag>& given) {
    for (const RenderFlag& flag : RenderFlags()) {
      const std::string name(flag.name);
      names_.push_back(name);
      CLI::Option* option = nullptr;
      std::vector<std::string>& values = value_lists_.emplace_back();
      if (flag.metavar.empty()) {
        option = app_.add_flag(name);
        switches_.push_back(name);
      } else {
        option = app_.add_option(name, values)->allow_extra_args(false);
      }
      entries_.push_back({std::string(flag.group),
                          name + (flag.metavar.empty() ? "" : " ") + std::string(flag.metavar),
                          std::string(flag.help)});
      const bool repeatable = flag.repeatable;
      checks_.push_back([=, &values, &given]() -> absl::Status {
        if (option->count() == 0) return absl::OkStatus();
        if (values.empty()) {
          given.emplace_back(name, "");
        } else {
          const size_t first = repeatable ? 0 : values.size() - 1;
          for (size_t i = first; i < values.size(); ++i) given.emplace_back(name, values[i]);
        }
        return absl::OkStatus();
      });
    }
  }

  // After the line was split.
  absl::Status Check() const {
    const std::vector<std::string> extras = app_.remaining();
    for (const std::string& extra : extras) {
      if (extra.size() > 1 && extra[0] == '-' && extra != "--") {
        return Unknown(extra.substr(0, extra.find('=')));
      }
    }
    if (!extras.empty()) {
      return Bad("'" + extras[0] + "' is one argument too many; see farpoint " + app_.get_name() +
                 " --help");
    }
    for (const auto& check : checks_) FP_RETURN_IF_ERROR(check());
    return absl::OkStatus();
  }

  absl::Status Unknown(const std::string& name) const {
    for (const RefusedFlag& flag : RefusedFlags()) {
      if (name == flag.name) return Bad(name + ": " + std::string(flag.reason));
    }
    const std::string nearest = NearestName(name, names_);
    return Bad(name + ": unknown flag of farpoint " + app_.get_name() +
               (nearest.empty() ? "; see farpoint " + app_.get_name() + " --help"
                                : "; did you mean " + nearest + "?"));
  }

  bool Knows(const std::string& name) const {
    return std::find(names_.begin(), names_.end(), name) != names_.end();
  }
  bool IsSwitch(const std::string& name) const {
    return std::find(switches_.begin(), switches_.end(), name) != switches_.end();
  }
  bool help_wanted() const { return help_; }
  // Groups in the order in which they were declared, "General" last.
  std::string Help(const std::string& summary) const {
    std::string usage = "farpoint " + app_.get_name(), text;
    std::vector<std::string> groups;
    for (const Entry& entry : entries_) {
      if (entry.group.empty()) usage += " " + entry.names;
      if (std::find(groups.begin(), groups.end(), entry.group) == groups.end()) {
        groups.push_back(entry.group);
      }
    }
    std::stable_partition(groups.begin(), groups.end(),
                          [](const std::string& group) { return group != "General"; });
    for (const std::string& group : groups) {
      text += "\n" + (group.empty() ? "" : group + ":\n");
      for (const Entry& entry : entries_) {
        if (entry.group == group) text += HelpEntry(entry.names, entry.help);
      }
    }
    return usage + " [flags]\n" + summary + "\n" + text;
  }
  CLI::App& app() { return app_; }

 private:
  struct Entry {
    std::string group, names, help;
  };

  CLI::App& app_;
  bool help_ = false;
  std::vector<Entry> entries_;
  std::vector<std::string> names_, switches_;
  std::list<std::string> texts_;                     // stable addresses
  std::list<std::vector<std::string>> value_lists_;  // stable addresses
  std::vector<std::function<absl::Status()>> checks_;
};

struct VerbInfo {
  Verb verb;
  const char* name;
  const char* help;
};
constexpr VerbInfo kVerbs[] = {
    {Verb::kRender, "render", "render a scene in this process, on all cores"},
    {Verb::kSubmit, "submit", "render a scene on a farm, wait for it and stitch the image"},
    {Verb::kStatus, "status", "what the farm's jobs and workers do"},
    {Verb::kCancel, "cancel", "cancel a job"},
    {Verb::kFetch, "fetch", "stitch the image of a job that was submitted before"},
    {Verb::kCompare, "compare", "measure how an image differs from a reference"},
};

constexpr char kOverview[] =
    "farpoint renders glTF scenes with factorized point-based global illumination.\n"
    "\n"
    "  farpoint render SCENE -o OUT.exr [flags]\n"
    "  farpoint submit SCENE -o OUT.exr --coordinator HOST:PORT [flags]\n"
    "  farpoint status [JOB] --coordinator HOST:PORT [--json FILE]\n"
    "  farpoint cancel JOB --coordinator HOST:PORT\n"
    "  farpoint fetch JOB -o OUT.exr --coordinator HOST:PORT\n"
    "  farpoint compare IMAGE REFERENCE [--layer NAME] [--mask FILE] [--json FILE]\n"
    "\n"
    "  farpoint COMMAND --help     the flags of a command\n"
    "  farpoint --version\n"
    "\n"
    "SCENE is .gltf, .glb or a job file .json. FARPOINT_COORDINATOR stands in for --coordinator.\n"
    "Exit codes: 0 done; 2 wrong usage; 42 the scene or the settings are wrong; 75 try again;\n"
    "130, 143 stopped by a signal.\n";

// What the numbers of the options are parsed into, before they are copied.
struct Parsed {
  std::optional<uint32_t> workers, threads;
  std::optional<double> patience, exposure, noise;
  std::optional<int32_t> priority;
  std::string title;
  std::string log_level = "info";
  std::string config;
};

void DeclareCommon(Options& options, CommandLine& line, Parsed& parsed) {
  options.Flag("--quiet", line.quiet, "no progress and no notes", "General");
  options.Text("--log-level", "LEVEL", parsed.log_level,
               "debug, info (the default), warn, error or off", "General");
  options.Text("--config", "FILE", parsed.config,
               "flags from a file, one 'name = value' a line; the command line overrides it",
               "General");
}

void DeclareCoordinator(Options& options, CommandLine& line, Parsed& parsed) {
  options.Text("--coordinator", "HOST:PORT", line.coordinator,
               "the farm's coordinator; default: FARPOINT_COORDINATOR", "Farm");
  options.Number<double>("--patience", "SECONDS", parsed.patience, 0, 1e6,
                         "how long an unreachable coordinator is waited for; default 60", "Farm");
}

void DeclareImage(Options& options, CommandLine& line, Parsed& parsed) {
  options.Text("-o,--output", "OUT.exr", line.output, "the image to write", "Output");
  options.Text("--png", "FILE", line.png, "an 8-bit sRGB preview too", "Output");
  options.Number<double>("--exposure", "STOPS", parsed.exposure, -64, 64,
                         "exposure of the preview; default 0", "Output");
  options.Text("--json", "FILE", line.json, "statistics; - for stdout", "Output");
}

void Declare(Options& options, CommandLine& line, Parsed& parsed) {
  switch (line.verb) {
    case Verb::kRender:
    case Verb::kSubmit:
      options.Positional("SCENE", line.scene, ".gltf, .glb or a job file .json");
      DeclareImage(options, line, parsed);
      options.Render(line.render_flags);
      options.Number<uint32_t>("--workers", "N", parsed.workers, 1, 256,
                               "render: workers in this process; default 1",
                               "Speed only (no pixel changes)");
      options.Number<uint32_t>("--threads", "N", parsed.threads, 0, 4096,
                               "render: threads of each worker; default 0: all cores",
                               "Speed only (no pixel changes)");
      if (line.verb == Verb::kSubmit) {
        DeclareCoordinator(options, line, parsed);
        options.Flag("--detach", line.detach, "print the job's id and do not wait", "Farm");
        options.Text("--title", "TEXT", parsed.title, "the job's name for people", "Farm");
        options.Number<int32_t>("--priority", "N", parsed.priority, -1000, 1000,
                                "higher goes first; default 0", "Farm");
      }
      break;
    case Verb::kStatus:
      options.Positional("JOB", line.job, "a job's id; default: all jobs and workers");
      options.Text("--json", "FILE", line.json, "as JSON; - for stdout", "Output");
      DeclareCoordinator(options, line, parsed);
      break;
    case Verb::kCancel:
      options.Positional("JOB", line.job, "the job's id");
      DeclareCoordinator(options, line, parsed);
      break;
    case Verb::kFetch:
      options.Positional("JOB", line.job, "the job's id");
      DeclareImage(options, line, parsed);
      DeclareCoordinator(options, line, parsed);
      break;
    case Verb::kCompare:
      options.Positional("IMAGE", line.image_a, "the image");
      options.Positional("REFERENCE", line.image_b, "what it is compared with");
      options.Text("--layer", "NAME", line.layer, "the image's layer; default: the beauty",
                   "Comparison");
      options.Text("--ref-layer", "NAME", line.ref_layer,
                   "the reference's layer; default: the same", "Comparison");
      options.Text("--mask", "FILE", line.mask,
                   "only pixels that are above 0.5 in this .exr or .npy", "Comparison");
      options.Number<double>("--noise", "X", parsed.noise, 0, 1e6,
                             "relative RMSE of the reference itself, taken out of rr",
                             "Comparison");
      options.Text("--diff", "FILE.png", line.diff, "the absolute difference in false colour",
                   "Output");
      options.Text("--json", "FILE", line.json, "the measures; - for stdout", "Output");
      break;
  }
  DeclareCommon(options, line, parsed);
}

std::string_view Trim(std::string_view text) {
  while (!text.empty() && (text.front() == ' ' || text.front() == '\t')) text.remove_prefix(1);
  while (!text.empty() && (text.back() == ' ' || text.back() == '\t' || text.back() == '\r')) {
    text.remove_suffix(1);
  }
  return text;
}

// The file's lines as arguments. "name = value" is --name=value; a flag without value wants true or
// false.
absl::StatusOr<std::vector<std::string>> ReadConfig(const std::string& path,
                                                    const Options& options) {
  FP_ASSIGN_OR_RETURN(const Blob blob, ReadFile(path, kMaxConfigBytes));
  std::string_view rest(reinterpret_cast<const char*>(blob.bytes().data()), blob.size());
  std::vector<std::string> args;
  for (int number = 1; !rest.empty(); ++number) {
    const size_t end = rest.find('\n');
    const std::string_view line = Trim(rest.substr(0, end));
    rest.remove_prefix(end == std::string_view::npos ? rest.size() : end + 1);
    if (line.empty() || line[0] == '#' || line[0] == ';') continue;
    const std::string where = path + ":" + std::to_string(number);
    const size_t equals = line.find('=');
    if (equals == std::string_view::npos) {
      return Bad(where + ": expected 'name = value', e.g. 'spp = 4'");
    }
    const std::string name = "--" + std::string(Trim(line.substr(0, equals)));
    std::string_view value = Trim(line.substr(equals + 1));
    if (value.size() >= 2 && (value[0] == '"' || value[0] == '\'') && value.back() == value[0]) {
      value = value.substr(1, value.size() - 2);
    }
    if (!options.Knows(name) || name == "--help") {
      return Annotate(options.Unknown(name), where);
    }
    if (name == "--config") return Bad(where + ": a configuration file cannot name another one");
    if (!options.IsSwitch(name)) {
      args.push_back(name + "=" + std::string(value));
    } else if (value == "true") {
      args.push_back(name);
    } else if (value != "false") {
      return Bad(where + ": " + name.substr(2) + " is a switch: expected true or false");
    }
  }
  return args;
}

absl::Status Split(Options& options, std::span<const std::string> args) {
  std::vector<std::string> reversed(args.rbegin(), args.rend());
  try {
    options.app().parse(reversed);
  } catch (const CLI::ParseError& error) {
    return Bad(std::string(error.what()) + "; see farpoint " + options.app().get_name() +
               " --help");
  }
  return options.Check();
}

absl::Status CheckCoordinator(const std::string& address) {
  if (address.empty()) {
    return Bad("--coordinator: not given; say HOST:PORT or set FARPOINT_COORDINATOR");
  }
  const size_t colon = address.rfind(':');
  int port = 0;
  const char* end = address.data() + address.size();
  const bool has_port = colon != std::string::npos && colon > 0 &&
                        std::from_chars(address.data() + colon + 1, end, port).ptr == end &&
                        port > 0 && port < 65536;
  if (!has_port) {
    return Bad("--coordinator " + address + ": expected HOST:PORT, e.g. farm.example:7447");
  }
  return absl::OkStatus();
}

absl::Status CheckNeeds(const CommandLine& line) {
  const bool renders = line.verb == Verb::kRender || line.verb == Verb::kSubmit;
  if (renders) {
    if (line.scene.empty()) {
      return Bad("SCENE: not given; name a .gltf, .glb or a job file .json");
    }
    FP_RETURN_IF_ERROR(CheckScenePath(line.scene));
  }
  const bool writes = (renders && !line.detach) || line.verb == Verb::kFetch;
  if (writes) {
    if (line.output.empty()) return Bad("-o: not given; name the image to write, e.g. -o out.exr");
    if (!line.output.ends_with(".exr")) {
      return Bad("-o " + line.output + ": images are OpenEXR files; end the name in .exr");
    }
    if (!line.png.empty() && !line.png.ends_with(".png")) {
      return Bad("--png " + line.png + ": previews are PNG files; end the name in .png");
    }
  }
  if (line.detach && !(line.output.empty() && line.png.empty() && line.json.empty())) {
    return Bad(
        "--detach: does not wait for an image; leave -o, --png and --json to farpoint fetch");
  }
  if ((line.verb == Verb::kCancel || line.verb == Verb::kFetch) && line.job.empty()) {
    return Bad("JOB: not given; farpoint status lists the jobs");
  }
  if (line.verb == Verb::kCompare && (line.image_a.empty() || line.image_b.empty())) {
    return Bad("IMAGE, REFERENCE: not given; name two .exr files");
  }
  if (line.verb != Verb::kRender && line.verb != Verb::kCompare) {
    FP_RETURN_IF_ERROR(CheckCoordinator(line.coordinator));
  }
  return absl::OkStatus();
}

}  // namespace

absl::StatusOr<CommandLine> ParseCommandLine(std::span<const std::string> args,
                                             const std::string& environment_coordinator) {
  CommandLine line;
  if (args.empty()) return Bad("no command given; see farpoint --help");
  if (args[0] == "--help" || args[0] == "-h" || args[0] == "help") {
    line.print = kOverview;
    return line;
  }
  if (args[0] == "--version") {
    line.print = "farpoint " FARPOINT_VERSION "\n";
    return line;
  }
  const auto* verb = std::find_if(std::begin(kVerbs), std::end(kVerbs),
                                  [&](const VerbInfo& info) { return args[0] == info.name; });
  if (verb == std::end(kVerbs)) {
    std::vector<std::string> names = {"--help", "--version"};
    for (const VerbInfo& info : kVerbs) names.emplace_back(info.name);
    const std::string nearest = NearestName(args[0], names);
    return Bad(args[0] + ": unknown command; " +
               (nearest.empty() ? "see farpoint --help" : "did you mean " + nearest + "?"));
  }
  args = args.subspan(1);

  Parsed parsed;
  // The first reading finds --config, the second one has the file's lines in front.
  std::vector<std::string> all(args.begin(), args.end());
  for (int reading = 0; reading < 2; ++reading) {
    line = {};
    line.verb = verb->verb;
    const std::string config = parsed.config;
    parsed = {};
    CLI::App app(verb->help, verb->name);
    Options options(app);
    Declare(options, line, parsed);
    if (reading == 1) {
      FP_ASSIGN_OR_RETURN(all, ReadConfig(config, options));
      all.insert(all.end(), args.begin(), args.end());
    }
    FP_RETURN_IF_ERROR(Split(options, all));
    if (options.help_wanted()) {
      line.print = options.Help(verb->help);
      return line;
    }
    if (parsed.config.empty()) break;
  }

  auto level = ConsoleLevelFromName(parsed.log_level);
  FP_RETURN_IF_ERROR(Annotate(level.status(), "--log-level " + parsed.log_level));
  line.log_level = *level;
  line.farm_ignores = line.verb == Verb::kSubmit && (parsed.workers || parsed.threads);
  line.workers = parsed.workers.value_or(line.workers);
  line.threads = parsed.threads.value_or(line.threads);
  line.patience_s = parsed.patience.value_or(line.patience_s);
  line.exposure_stops = static_cast<float>(parsed.exposure.value_or(0));
  line.noise = parsed.noise.value_or(0);
  line.priority = parsed.priority;
  if (!parsed.title.empty()) line.title = parsed.title;
  if (parsed.title.size() > 200) return Bad("--title: is longer than 200 bytes; shorten it");
  if (line.coordinator.empty()) line.coordinator = environment_coordinator;
  FP_RETURN_IF_ERROR(CheckNeeds(line));
  return line;
}

}  // namespace farpoint
