// The commands of the program, one function each.
#pragma once

#include "client/command_line.h"
#include "client/console.h"
#include "client/stop_flag.h"

namespace farpoint {

// Does what the line says; errors are reported on the console. Returns the exit code.
int RunCommand(const CommandLine& line, const StopFlag& stop, Console& console);

}  // namespace farpoint
