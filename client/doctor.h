// farpoint doctor: looks at all that a farm needs, from this process's limits to the coordinator's
// store, and says of each fault its cause and its cure in one line. Changes nothing, but for a
// small file that is written into a folder and removed.
#pragma once

#include <chrono>
#include <cstdint>
#include <functional>
#include <memory>
#include <span>
#include <string>
#include <vector>

#include "client/farm_link.h"
#include "core/base/machine.h"
#include "core/base/status.h"
#include "proto/connection_probe.h"
#include "proto/job.h"
#include "proto/tls_files.h"

namespace farpoint {

enum class Health { kGood, kDoubtful, kBad };

struct Finding {
  Health health = Health::kGood;
  std::string what;  // one word, stable: "address", "clock", "workers", …
  std::string text;  // of a fault: its cause; its cure
  // Of a fault whether trying again may help (kUnavailable) or not (kFailedPrecondition).
  absl::StatusCode code = absl::StatusCode::kOk;
};

// What shall be looked at; what is empty is left out.
struct DoctorRequest {
  std::string coordinator;  // HOST:PORT
  TlsFlags tls;
  std::string token_file;
  Role role = Role::kClient;  // whose certificate of tls.directory
  std::string scene;
  uint64_t points = 0;  // surfels of the scene; 0: not known
  std::string store, listen, cache, blob_directory;
  std::chrono::milliseconds patience{4000};  // with a coordinator that does not answer
};

// In the order in which they were looked at. `connect` makes the link to the coordinator.
using Connect = std::function<std::unique_ptr<FarmLink>(const ChannelSecurity& security)>;
std::vector<Finding> Examine(const DoctorRequest& request, const Connect& connect);

// The parts that need nothing but facts.
struct OwnFacts {
  int64_t unix_ms = 0;  // when the coordinator was asked
  bool tls = false;
  int64_t certificate_not_after_s = 0;  // 0: none
};
std::vector<Finding> JudgeCoordinator(const CoordinatorHealth& health, const OwnFacts& own);
std::vector<Finding> JudgeWorkers(std::span<const WorkerStatus> workers);
std::vector<Finding> JudgeProcess(const OpenFileFacts& files);

// A line each, "ok", "note" or "FAULT" in front; and as JSON.
std::string FindingsText(std::span<const Finding> findings);
std::string FindingsJson(std::span<const Finding> findings);
// OK if nothing is bad. Else how many faults there are; kUnavailable if trying again may cure all
// of them.
absl::Status OutcomeOf(std::span<const Finding> findings);

}  // namespace farpoint
