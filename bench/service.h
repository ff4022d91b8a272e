// The tile service under fire: real processes on one machine that are killed, stopped, slowed, cut
// off, lied to and overloaded, held against what may never happen (a tile lost, committed twice or
// accepted with a wrong bit) and against bounds of time. docs/service.md lists the cases.
//
// Built only with the service (FARPOINT_SERVICE); it starts the programs farpoint-server,
// farpoint-worker and farpoint beside its own.
#pragma once

#include <array>
#include <cstdint>
#include <functional>
#include <string>
#include <string_view>
#include <vector>

#include "core/base/status.h"

namespace farpoint {

struct ServiceOptions {
  std::vector<std::string> cases;  // names, see kServiceNames; empty: all
  std::string bin_dir;             // of the programs; empty: that of this program
  uint64_t seed = 1;               // of kills, stops, faults of the network
  bool quick = false;              // few of everything
};

// One figure. A count (bytes, shares of work and of trials, too) must hold on any machine; a time
// is a bound for an idle one, and is only told where others keep the machine busy.
struct ServiceCheck {
  enum class Kind { kCount, kTime, kFigure };  // kFigure: without a bound
  Kind kind = Kind::kCount;
  std::string what;  // with its unit
  double value = 0;
  double bound = 0;
  bool at_least = false;  // value >= bound holds, else value <= bound

  bool holds() const {
    return kind == Kind::kFigure || (at_least ? value >= bound : value <= bound);
  }
};

struct ServiceResult {
  std::string name;   // of the case
  std::string check;  // what is done and what is held against what, in words
  std::vector<ServiceCheck> checks;
  std::vector<std::string> notes;  // what could not be tried here, and why
  std::string error;               // the case could not be run to its end; else empty
  double seconds = 0;              // by the clock
  double load_average = 0;         // at its end

  size_t failures() const;  // counts that do not hold, and an error
  size_t late() const;      // times that do not hold
};

struct ServiceReport {
  ServiceOptions options;
  std::string date_utc, cpu;
  unsigned cores = 0;
  double load_average_start = 0, load_average_end = 0;
  std::vector<ServiceResult> results;

  size_t failures() const;
  size_t late() const;
};

// The names that --case takes, in the order in which they run.
inline constexpr std::array<std::string_view, 13> kServiceNames = {
    "schedules", "kills",     "coordinator", "fencing", "stragglers", "poison", "flips",
    "audits",    "broadcast", "network",     "load",    "cost",       "states"};

inline std::vector<std::string> ServiceNames() {
  return {kServiceNames.begin(), kServiceNames.end()};
}

// Runs the cases one after the other. What fails is a check, not an error. kInvalidArgument: an
// unknown case; kNotFound: a program is missing.
absl::StatusOr<ServiceReport> RunService(const ServiceOptions& options,
                                         const std::function<void(std::string_view)>& progress);

// A process of a case (bench/service_actor.h): "ROLE NAME=VALUE…"; its exit code.
int RunServiceActor(const std::vector<std::string>& args);

}  // namespace farpoint
