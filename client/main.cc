#include <unistd.h>

#include <cstdio>
#include <cstdlib>
#include <exception>
#include <string>
#include <vector>

#include "client/command_line.h"
#include "client/commands.h"
#include "client/console.h"
#include "client/exit_code.h"
#include "client/stop_flag.h"

int main(int argc, char** argv) {
  using namespace farpoint;
  const std::vector<std::string> args(argv + (argc > 0 ? 1 : 0), argv + argc);
  const char* coordinator = std::getenv("FARPOINT_COORDINATOR");
  const bool terminal = isatty(STDERR_FILENO) != 0;
  auto line = ParseCommandLine(args, coordinator == nullptr ? "" : coordinator);
  if (!line.ok()) {
    Console(stderr, terminal, ConsoleLevel::kError, true)
        .Error(std::string(line.status().message()));
    return kExitUsage;
  }
  if (line->print) {
    std::fputs(line->print->c_str(), stdout);
    return std::fflush(stdout) == 0 ? kExitOk : kExitTryAgain;
  }
  const char* certs = std::getenv("FARPOINT_CERTS");
  if (certs != nullptr && line->tls.empty() && !line->tls.insecure) line->tls.directory = certs;
  Console console(stderr, terminal, line->log_level, line->quiet);
  try {
    return RunCommand(*line, ProcessStopFlag(), console);
  } catch (const std::bad_alloc&) {
    console.Error("not enough memory; render a smaller film or fewer points");
    return kExitTryAgain;
  } catch (const std::exception& error) {
    console.Error(std::string("unexpected failure: ") + error.what());
    return kExitPermanent;
  }
}
