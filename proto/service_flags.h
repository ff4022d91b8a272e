// The command lines of the services: errors as farpoint's own. For main.cc only: CLI11 is slow to
// compile.
#pragma once

#include <CLI/CLI.hpp>
#include <algorithm>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "core/base/nearest_name.h"
#include "proto/service_main.h"

namespace farpoint {

// The exit code if the program is to end: 0 after --help and --version, kServiceExitUsage after one
// line on stderr that names the flag, and the nearest one where it is unknown.
inline std::optional<int> ParseServiceFlags(CLI::App& app, std::string_view program, int argc,
                                            char** argv) {
  try {
    app.parse(argc, argv);
    return std::nullopt;
  } catch (const CLI::ParseError& error) {
    if (error.get_exit_code() == 0) return app.exit(error);
    std::string text = error.what();
    std::string where = "; see " + std::string(program) + " --help";
    std::vector<std::string> names;
    for (const CLI::Option* option : app.get_options()) {
      for (const std::string& name : option->get_lnames()) names.push_back("--" + name);
    }
    // Unknown flags, with the values that nobody took. They explain what is missing, too.
    const std::vector<std::string> extras = app.remaining();
    const auto is_flag = [](const std::string& extra) { return extra.starts_with("-"); };
    const auto unknown = std::find_if(extras.begin(), extras.end(), is_flag);
    if (unknown != extras.end()) {
      const std::string flag = unknown->substr(0, unknown->find('='));
      const std::string nearest = NearestName(flag, names);
      text = flag + ": unknown flag";
      if (!nearest.empty()) where = "; did you mean " + nearest + "?";
    } else if (!extras.empty()) {
      text = "'" + extras.front() + "' is one argument too many";
    }
    ReportFatal(program, absl::InvalidArgumentError(text + where));
    return kServiceExitUsage;
  }
}

}  // namespace farpoint
