#include "client/command_line.h"

#include <CLI/CLI.hpp>
#include <algorithm>
#include <cctype>
#include <charconv>
#include <cmath>
#include <list>
#include <map>
#include <memory>
#include <string_view>

#include "client/frame_range.h"
#include "core/base/blob.h"
#include "core/base/nearest_name.h"

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
    switches_.push_back("--help");
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

  // May be repeated; each value may be several with commas.
  void List(const std::string& name, const std::string& metavar, std::vector<std::string>& target,
            const std::string& help, const std::string& group) {
    std::vector<std::string>& values = value_lists_.emplace_back();
    app_.add_option(name, values)->allow_extra_args(false);
    names_.push_back(name);
    entries_.push_back({group, name + " " + metavar, help});
    checks_.push_back([=, &values, &target]() -> absl::Status {
      for (std::string_view rest : values) {
        while (true) {
          const size_t comma = rest.find(',');
          if (comma == 0 || rest.empty()) {
            return Bad(name + ": expected " + metavar + " without empty places");
          }
          target.emplace_back(rest.substr(0, comma));
          if (comma == std::string_view::npos) break;
          rest.remove_prefix(comma + 1);
        }
      }
      return absl::OkStatus();
    });
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
      return ParseNumber(name, text, target, min, max);
    });
  }

  void Positional(const std::string& name, std::string& target, const std::string& help) {
    app_.add_option(name, target);
    entries_.push_back({"", name, help});
  }
  // All that stand beside flags.
  void Positionals(const std::string& name, std::vector<std::string>& target,
                   const std::string& help) {
    app_.add_option(name, target);
    entries_.push_back({"", name, help});
  }
  // After the positionals above. May be negative, though it then looks like a flag.
  template <typename T>
  void PositionalNumber(const std::string& name, std::optional<T>& target, T min, T max,
                        const std::string& help) {
    number_ = &texts_.emplace_back();
    std::string& text = *number_;
    app_.add_option(name, text);
    entries_.push_back({"", name, help});
    checks_.push_back([=, &text, &target]() -> absl::Status {
      if (text.empty()) return absl::OkStatus();
      return ParseNumber(name, text, target, min, max);
    });
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

  // Before the line is split: what CLI11 would refuse in words of its own.
  absl::Status CheckValues(std::span<const std::string> args) const {
    for (size_t i = 0; i < args.size() && args[i] != "--"; ++i) {
      const size_t equals = args[i].find('=');
      const std::string name = args[i].substr(0, equals);
      if (!Knows(name) && name != "-o") continue;
      if (IsSwitch(name)) {
        if (equals == std::string::npos) continue;
        return Bad(name + ": is a switch and takes no value");
      }
      const bool joined = equals != std::string::npos;
      const std::string value = joined                ? args[i].substr(equals + 1)
                                : i + 1 < args.size() ? args[i + 1]
                                                      : std::string();
      if (value.empty() || (!joined && Knows(value.substr(0, value.find('='))))) {
        return Bad(name + ": needs a value; see farpoint " + app_.get_name() + " --help");
      }
      if (!joined) ++i;
    }
    return absl::OkStatus();
  }

  // After the line was split.
  absl::Status Check() const {
    std::vector<std::string> extras = app_.remaining();
    if (number_ != nullptr && number_->empty() && !extras.empty() && extras[0].size() > 1 &&
        extras[0][0] == '-' && extras[0][1] >= '0' && extras[0][1] <= '9') {
      *number_ = extras[0];
      extras.erase(extras.begin());
    }
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

  template <typename T>
  static absl::Status ParseNumber(const std::string& name, const std::string& text,
                                  std::optional<T>& target, T min, T max) {
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
  }

  CLI::App& app_;
  bool help_ = false;
  std::vector<Entry> entries_;
  std::vector<std::string> names_, switches_;
  std::list<std::string> texts_;                     // stable addresses
  std::list<std::vector<std::string>> value_lists_;  // stable addresses
  std::vector<std::function<absl::Status()>> checks_;
  std::string* number_ = nullptr;  // the text of PositionalNumber
};

struct VerbInfo {
  Verb verb;
  const char* name;
  const char* help;
};
constexpr VerbInfo kVerbs[] = {
    {Verb::kRender, "render", "render a scene in this process, on all cores"},
    {Verb::kSubmit, "submit", "render a scene on a farm, wait for it and stitch its images"},
    {Verb::kStatus, "status", "what the farm's jobs and workers do"},
    {Verb::kWatch, "watch", "follow jobs to their end; without JOB all that have not ended"},
    {Verb::kFetch, "fetch", "stitch the images of a job that was submitted before"},
    {Verb::kPause, "pause", "let jobs rest: tiles in work are finished, no new ones start"},
    {Verb::kResume, "resume", "let paused jobs go on"},
    {Verb::kCancel, "cancel", "end jobs"},
    {Verb::kRequeue, "requeue", "let failed or cancelled jobs go on where they were"},
    {Verb::kPriority, "priority", "change a job's priority; higher goes first"},
    {Verb::kWorkers, "workers", "the farm's workers"},
    {Verb::kLogs, "logs", "what happened to a job"},
    {Verb::kExplain, "explain", "why a job is in the state that it is in"},
    {Verb::kCompare, "compare", "measure how an image differs from a reference"},
    {Verb::kCerts, "certs",
     "make certificates and tokens for a farm: init, add, show, token, revoke"},
    {Verb::kDoctor, "doctor", "find out what keeps a farm from working, and say what to do"},
};

constexpr char kOverview[] =
    "farpoint renders scenes with factorized point-based global illumination.\n"
    "\n"
    "  farpoint render SCENE -o OUT.exr [flags]\n"
    "  farpoint submit SCENE -o OUT.exr --coordinator HOST:PORT [flags]\n"
    "  farpoint status [JOB]            jobs and workers\n"
    "  farpoint watch [JOB...]          follow jobs to their end\n"
    "  farpoint fetch JOB -o OUT.exr    the images of a job\n"
    "  farpoint pause | resume | cancel JOB...\n"
    "  farpoint requeue JOB... [--all]\n"
    "  farpoint priority JOB N\n"
    "  farpoint logs JOB [--follow]\n"
    "  farpoint explain JOB\n"
    "  farpoint workers\n"
    "  farpoint compare IMAGE REFERENCE [--layer NAME] [--mask FILE] [--json FILE]\n"
    "  farpoint certs init | add | show | token | revoke [NAME] [--dir DIR]\n"
    "  farpoint doctor [SCENE] [--coordinator HOST:PORT]\n"
    "\n"
    "  farpoint COMMAND --help     the flags of a command\n"
    "  farpoint --version\n"
    "\n"
    "SCENE is a scene file or a job file .json. FARPOINT_COORDINATOR stands in for --coordinator,\n"
    "FARPOINT_CERTS for --certs.\n"
    "Exit codes: 0 done; 2 wrong usage; 42 the scene or the settings are wrong; 75 try again;\n"
    "130, 143 stopped by a signal.\n";

// What the numbers of the options are parsed into, before they are copied.
struct Parsed {
  std::optional<uint32_t> workers, threads;
  std::optional<double> patience, exposure, noise;
  std::optional<int32_t> priority;
  std::string title;
  std::string compression = "zip";
  std::string frames;
  std::string log_level = "info";
  std::string config;
  std::string certs_action, certs_role;
  std::optional<uint32_t> days;
  std::optional<uint64_t> points;
};

void DeclareCommon(Options& options, CommandLine& line, Parsed& parsed) {
  options.Flag("--quiet", line.quiet, "no progress and no notes", "General");
  options.Text("--log-level", "LEVEL", parsed.log_level,
               "debug, info (the default), warn, error or off", "General");
  options.Text("--config", "FILE", parsed.config,
               "flags from a file, one 'name = value' a line; the command line overrides it",
               "General");
}

void DeclareSecurity(Options& options, CommandLine& line) {
  options.Text("--certs", "DIR", line.tls.directory,
               "folder of farpoint certs: speak TLS; default: FARPOINT_CERTS", "Farm");
  options.Text("--tls-ca", "FILE", line.tls.paths.ca,
               "the authority's certificate, if not in --certs", "Farm");
  options.Text("--tls-cert", "FILE", line.tls.paths.certificate, "one's own certificate", "Farm");
  options.Text("--tls-key", "FILE", line.tls.paths.key, "its key", "Farm");
  options.Text("--token-file", "FILE", line.token_file,
               "a token in place of a certificate; with --tls-ca or --certs", "Farm");
  options.Flag("--insecure", line.tls.insecure,
               "talk without TLS to a coordinator that is not on this machine", "Farm");
}

void DeclareCoordinator(Options& options, CommandLine& line, Parsed& parsed) {
  options.Text("--coordinator", "HOST:PORT", line.coordinator,
               "the farm's coordinator; default: FARPOINT_COORDINATOR", "Farm");
  options.Number<double>("--patience", "SECONDS", parsed.patience, 0, 1e6,
                         "how long an unreachable coordinator is waited for; default 60", "Farm");
  DeclareSecurity(options, line);
}

void DeclareDisplay(Options& options, CommandLine& line) {
  options.Text(
      "--display-server", "HOST:PORT", line.display_server,
      "show tiles as they come in a viewer that speaks tev's protocol, as tev does on port "
      "14158",
      "Output");
}

void DeclareImage(Options& options, CommandLine& line, Parsed& parsed) {
  options.Text("-o,--output", "OUT.exr", line.output,
               "the image to write; out.####.exr or out.%04d.exr for a sequence", "Output");
  options.Text("--compression", "NAME", parsed.compression,
               "of the image: none, rle, zips, zip (the default), piz, or dwaa, which is lossy",
               "Output");
  options.Text("--png", "FILE", line.png, "an 8-bit sRGB preview too", "Output");
  options.Number<double>("--exposure", "STOPS", parsed.exposure, -64, 64,
                         "exposure of the preview; default 0", "Output");
  options.Text("--json", "FILE", line.json, "statistics; - for stdout", "Output");
  DeclareDisplay(options, line);
}

// What every command has that asks a coordinator.
void DeclareFarm(Options& options, CommandLine& line, Parsed& parsed, const std::string& json) {
  options.Text("--json", "FILE", line.json, json, "Output");
  DeclareCoordinator(options, line, parsed);
}

void Declare(Options& options, CommandLine& line, Parsed& parsed) {
  switch (line.verb) {
    case Verb::kRender:
    case Verb::kSubmit:
      options.Positional("SCENE", line.scene, "a scene file or a job file .json");
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
        options.Flag("--detach", line.detach,
                     "print the job's id and do not wait; farpoint fetch gets the images", "Farm");
        options.Text("--title", "TEXT", parsed.title, "the job's name for people", "Farm");
        options.Number<int32_t>("--priority", "N", parsed.priority, kMinPriority, kMaxPriority,
                                "higher goes first; default 0", "Farm");
        options.List("--after", "JOB[,JOB]", line.after,
                     "start when these jobs are done; may be repeated", "Farm");
        options.Flag("--paused", line.paused, "start paused; farpoint resume lets it go", "Farm");
      }
      break;
    case Verb::kStatus:
      options.Positionals("JOB", line.jobs, "a job's id; default: all jobs and workers");
      DeclareFarm(options, line, parsed, "as JSON; - for stdout");
      break;
    case Verb::kWatch:
      options.Positionals("JOB", line.jobs, "ids of jobs; default: all that have not ended");
      DeclareFarm(options, line, parsed, "how the jobs ended, as JSON; - for stdout");
      DeclareDisplay(options, line);
      break;
    case Verb::kPause:
    case Verb::kResume:
    case Verb::kCancel:
      options.Positionals("JOB", line.jobs, "ids of jobs");
      DeclareFarm(options, line, parsed, "the jobs' status afterwards, as JSON; - for stdout");
      break;
    case Verb::kRequeue:
      options.Positionals("JOB", line.jobs, "ids of jobs");
      options.Flag("--all", line.all, "render every tile again, also of jobs that are done",
                   "Requeue");
      DeclareFarm(options, line, parsed, "the jobs' status afterwards, as JSON; - for stdout");
      break;
    case Verb::kPriority:
      options.Positional("JOB", line.jobs.emplace_back(), "the job's id");
      options.PositionalNumber<int32_t>("N", parsed.priority, kMinPriority, kMaxPriority,
                                        "its priority, -1000..1000; higher goes first");
      DeclareFarm(options, line, parsed, "the job's status afterwards, as JSON; - for stdout");
      break;
    case Verb::kWorkers:
      DeclareFarm(options, line, parsed, "as JSON; - for stdout");
      break;
    case Verb::kLogs:
      options.Positionals("JOB", line.jobs, "the job's id");
      options.Flag("--follow", line.follow, "go on until the job has ended", "Log");
      DeclareFarm(options, line, parsed, "an object on each line; - for stdout");
      break;
    case Verb::kExplain:
      options.Positionals("JOB", line.jobs, "the job's id");
      DeclareFarm(options, line, parsed, "as JSON; - for stdout");
      break;
    case Verb::kFetch:
      options.Positionals("JOB", line.jobs, "the job's id");
      DeclareImage(options, line, parsed);
      options.Text("--frames", "RANGE", parsed.frames,
                   "only these frames of a sequence, e.g. 1-10x2,15", "Fetch");
      options.Flag("--partial", line.partial,
                   "also images of which tiles are missing; those pixels are zero", "Fetch");
      options.Flag("--wait", line.wait, "wait for the job's end and write frames as they are done",
                   "Fetch");
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
    case Verb::kCerts:
      options.Positional(
          "ACTION", parsed.certs_action,
          "init: a farm's authority, server, workers and clients; add NAME: one more "
          "certificate; show; token NAME: a token for a client; revoke NAME");
      options.Positional("NAME", line.certs_name, "add, token, revoke: whose");
      options.Text("--dir", "DIR", line.certs_directory, "the folder; default: farpoint-certs",
                   "Farm");
      options.List(
          "--server", "HOST[,HOST]", line.certs_hosts,
          "init, add: the names and addresses by which the coordinator is reached; default: "
          "this machine's",
          "Certificates");
      options.Number<uint32_t>("--workers", "N", parsed.workers, 0, 10000,
                               "init: certificates for so many workers; default 1", "Certificates");
      options.List("--clients", "NAME[,NAME]", line.certs_clients, "init: clients; default: client",
                   "Certificates");
      options.Text("--role", "ROLE", parsed.certs_role,
                   "add: worker, client (the default), admin or server; token: client or admin",
                   "Certificates");
      options.Number<uint32_t>("--days", "N", parsed.days, 1, 36500,
                               "how long it holds; default 365", "Certificates");
      break;
    case Verb::kDoctor:
      options.Positional("SCENE", line.scene, "a scene: can it be rendered here and on the farm?");
      DeclareFarm(options, line, parsed, "what was found, as JSON; - for stdout");
      options.Text("--role", "ROLE", parsed.certs_role,
                   "whose certificate of --certs: client (the default), worker or server", "Farm");
      options.Text("--store", "DIR", line.store, "look at a coordinator's store on this machine",
                   "This machine");
      options.Text("--listen", "HOST:PORT", line.listen, "can a coordinator listen there?",
                   "This machine");
      options.Text("--cache", "DIR", line.cache, "look at a worker's cache on this machine",
                   "This machine");
      options.Text("--blob-dir", "DIR", line.blob_dir,
                   "is this the folder that the coordinator shares its blobs in?", "This machine");
      options.Number<uint64_t>("--points", "N", parsed.points, 1, uint64_t{1} << 40,
                               "surfels that the scene shall have", "This machine");
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
      if (value.empty()) return Bad(where + ": " + name.substr(2) + " needs a value");
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
  FP_RETURN_IF_ERROR(options.CheckValues(args));
  std::vector<std::string> reversed(args.rbegin(), args.rend());
  try {
    options.app().parse(reversed);
  } catch (const CLI::ParseError& error) {
    return Bad(std::string(error.what()) + "; see farpoint " + options.app().get_name() +
               " --help");
  }
  return options.Check();
}

absl::Status CheckAddress(const std::string& flag, const std::string& address,
                          const std::string& example) {
  const size_t colon = address.rfind(':');
  int port = 0;
  const char* end = address.data() + address.size();
  const bool has_port = colon != std::string::npos && colon > 0 &&
                        std::from_chars(address.data() + colon + 1, end, port).ptr == end &&
                        port > 0 && port < 65536;
  // A host of colons stands in brackets. Everything else that is no name would reach gRPC as an
  // address of some other scheme.
  const std::string_view host = std::string_view(address).substr(0, has_port ? colon : 0);
  const bool bracketed = host.size() > 2 && host.front() == '[' && host.back() == ']';
  const bool good_host = std::all_of(host.begin(), host.end(), [&](char c) {
    return std::isalnum(static_cast<unsigned char>(c)) != 0 || c == '-' || c == '.' || c == '_' ||
           (bracketed && (c == ':' || c == '[' || c == ']' || c == '%'));
  });
  if (!has_port || !good_host) {
    return Bad(flag + " " + address + ": expected HOST:PORT, e.g. " + example);
  }
  return absl::OkStatus();
}

absl::Status CheckCoordinator(const std::string& address) {
  if (address.empty()) {
    return Bad("--coordinator: not given; say HOST:PORT or set FARPOINT_COORDINATOR");
  }
  return CheckAddress("--coordinator", address, "farm.example:7447");
}

absl::Status CheckDisplay(const CommandLine& line) {
  if (line.display_server.empty()) return absl::OkStatus();
  if (line.detach) {
    return Bad("--display-server: with --detach no tile arrives here; leave one of both out");
  }
  if (line.verb == Verb::kWatch && line.jobs.size() != 1) {
    return Bad("--display-server: shows one job; name it");
  }
  return CheckAddress("--display-server", line.display_server, "127.0.0.1:14158");
}

absl::Status CheckJobs(const CommandLine& line) {
  size_t min = 1, max = SIZE_MAX;
  switch (line.verb) {
    case Verb::kStatus:
      min = 0, max = 1;
      break;
    case Verb::kWatch:
      min = 0;
      break;
    case Verb::kFetch:
    case Verb::kPriority:
    case Verb::kLogs:
    case Verb::kExplain:
      max = 1;
      break;
    case Verb::kPause:
    case Verb::kResume:
    case Verb::kCancel:
    case Verb::kRequeue:
      break;
    default:
      return absl::OkStatus();
  }
  if (line.jobs.size() > max) {
    return Bad("'" + line.jobs[max] + "' is one argument too many; one JOB at a time");
  }
  if (line.jobs.size() < min || (!line.jobs.empty() && line.jobs[0].empty())) {
    return Bad("JOB: not given; farpoint status lists the jobs");
  }
  if (line.verb == Verb::kPriority && !line.priority) {
    return Bad("N: not given; say the job's priority, -1000..1000");
  }
  return absl::OkStatus();
}

absl::Status CheckCerts(const CommandLine& line) {
  const bool named = line.certs_action == CertsAction::kAdd ||
                     line.certs_action == CertsAction::kToken ||
                     line.certs_action == CertsAction::kRevoke;
  if (named && line.certs_name.empty()) return Bad("NAME: not given; say whose it is");
  if (!named && !line.certs_name.empty()) {
    return Bad("'" + line.certs_name + "' is one argument too many; see farpoint certs --help");
  }
  if (line.certs_action == CertsAction::kAdd && line.certs_role != Role::kServer &&
      !line.certs_hosts.empty()) {
    return Bad("--server: only a server's certificate names hosts; say --role server");
  }
  if (line.certs_action == CertsAction::kToken && line.certs_role != Role::kClient &&
      line.certs_role != Role::kAdmin) {
    return Bad("--role: a token is a client's or an admin's; a " +
               std::string(NameOf(line.certs_role)) + " needs a certificate");
  }
  return absl::OkStatus();
}

absl::Status CheckNeeds(const CommandLine& line) {
  if (line.verb == Verb::kCerts) return CheckCerts(line);
  if (line.verb == Verb::kDoctor) {
    return line.coordinator.empty() ? absl::OkStatus() : CheckCoordinator(line.coordinator);
  }
  const bool renders = line.verb == Verb::kRender || line.verb == Verb::kSubmit;
  if (renders) {
    if (line.scene.empty()) {
      return Bad("SCENE: not given; name a scene file or a job file .json");
    }
    FP_RETURN_IF_ERROR(CheckScenePath(line.scene));
  }
  if (renders || line.verb == Verb::kFetch) {
    if (line.output.empty() && !line.detach) {
      return Bad("-o: not given; name the image to write, e.g. -o out.exr");
    }
    if (!line.output.empty() && !line.output.ends_with(".exr")) {
      return Bad("-o " + line.output + ": images are OpenEXR files; end the name in .exr");
    }
    if (!line.png.empty() && !line.png.ends_with(".png")) {
      return Bad("--png " + line.png + ": previews are PNG files; end the name in .png");
    }
  }
  if (line.after.size() > kMaxAfter) {
    return Bad("--after: names " + std::to_string(line.after.size()) +
               " jobs; a job can wait for at most " + std::to_string(kMaxAfter));
  }
  if (line.partial && line.wait) {
    return Bad("--partial: takes what is there now; leave --wait out");
  }
  FP_RETURN_IF_ERROR(CheckJobs(line));
  FP_RETURN_IF_ERROR(CheckDisplay(line));
  if (line.verb != Verb::kRender && line.verb != Verb::kCompare) {
    FP_RETURN_IF_ERROR(CheckCoordinator(line.coordinator));
  }
  if (!line.diff.empty() && !line.diff.ends_with(".png")) {
    return Bad("--diff " + line.diff + ": the difference is a PNG file; end the name in .png");
  }
  if (line.verb == Verb::kCompare && (line.image_a.empty() || line.image_b.empty())) {
    return Bad("IMAGE, REFERENCE: not given; name two .exr files");
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
  auto compression = ExrCompressionFromName(parsed.compression);
  FP_RETURN_IF_ERROR(Annotate(compression.status(), "--compression " + parsed.compression));
  line.compression = *compression;
  if (!parsed.frames.empty()) {
    auto frames = ParseFrameRange(parsed.frames);
    FP_RETURN_IF_ERROR(Annotate(frames.status(), "--frames " + parsed.frames));
    line.frames = *std::move(frames);
  }
  if (line.verb == Verb::kCerts) {
    constexpr const char* kActions[] = {"init", "add", "show", "token", "revoke"};
    const auto* action = std::find(std::begin(kActions), std::end(kActions), parsed.certs_action);
    if (action == std::end(kActions)) {
      return Bad(parsed.certs_action.empty()
                     ? "ACTION: not given; say init, add, show, token or revoke"
                     : parsed.certs_action +
                           ": unknown action; say init, add, show, token or revoke");
    }
    line.certs_action = static_cast<CertsAction>(action - std::begin(kActions));
    if (line.certs_directory.empty()) line.certs_directory = "farpoint-certs";
    line.certs_days = parsed.days.value_or(line.certs_days);
  }
  if (!parsed.certs_role.empty()) {
    const std::optional<Role> role = RoleFromName(parsed.certs_role);
    if (!role)
      return Bad("--role " + parsed.certs_role + ": expected worker, client, admin or server");
    line.certs_role = line.doctor_role = *role;
  } else if (line.verb == Verb::kCerts && line.certs_action == CertsAction::kAdd &&
             !line.certs_hosts.empty()) {
    line.certs_role = Role::kServer;
  }
  line.points = parsed.points.value_or(0);
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
