// farpoint-bench without its process: arguments in, exit code out.
#pragma once

#include <iosfwd>
#include <string>
#include <vector>

namespace farpoint {

// Results go to `out` and into files, progress and errors to `err`. 0; 2: the command line is
// wrong, or the benchmark is not in this build; 42: a scene, a reference or a setting is wrong; 75:
// try again (as of farpoint, docs/commands.md).
int RunBench(const std::vector<std::string>& args, std::ostream& out, std::ostream& err);

}  // namespace farpoint
