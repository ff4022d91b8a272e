// The cases of the service's benchmark, each a function that fills in a result. An error means that
// the case could not be run to its end.
#pragma once

#include <chrono>
#include <functional>
#include <random>
#include <string>
#include <string_view>

#include "bench/service.h"
#include "bench/service_farm.h"

namespace farpoint {

struct ServiceContext {
  const ServiceOptions& options;
  FarmPrograms programs;
  std::function<void(std::string_view)> progress;

  std::mt19937_64 Random() const { return std::mt19937_64(options.seed); }
  int Pick(int full, int quick) const { return options.quick ? quick : full; }
};

// --- Adding checks ---
inline void Count(ServiceResult& r, std::string what, double value, double at_most) {
  r.checks.push_back({ServiceCheck::Kind::kCount, std::move(what), value, at_most, false});
}
inline void CountAtLeast(ServiceResult& r, std::string what, double value, double at_least) {
  r.checks.push_back({ServiceCheck::Kind::kCount, std::move(what), value, at_least, true});
}
inline void Time(ServiceResult& r, std::string what, double value, double at_most) {
  r.checks.push_back({ServiceCheck::Kind::kTime, std::move(what), value, at_most, false});
}
inline void Rate(ServiceResult& r, std::string what, double value, double at_least) {
  r.checks.push_back({ServiceCheck::Kind::kTime, std::move(what), value, at_least, true});
}
inline void Figure(ServiceResult& r, std::string what, double value) {
  r.checks.push_back({ServiceCheck::Kind::kFigure, std::move(what), value, 0, false});
}

class Stopwatch {
 public:
  double seconds() const {
    return std::chrono::duration<double>(std::chrono::steady_clock::now() - start_).count();
  }

 private:
  std::chrono::steady_clock::time_point start_ = std::chrono::steady_clock::now();
};

// service_faults.cc
absl::Status RunSchedules(const ServiceContext& context, ServiceResult& result);
absl::Status RunKills(const ServiceContext& context, ServiceResult& result);
absl::Status RunCoordinatorDeath(const ServiceContext& context, ServiceResult& result);
absl::Status RunFencing(const ServiceContext& context, ServiceResult& result);
absl::Status RunStates(const ServiceContext& context, ServiceResult& result);
// service_trust.cc
absl::Status RunPoison(const ServiceContext& context, ServiceResult& result);
absl::Status RunFlips(const ServiceContext& context, ServiceResult& result);
absl::Status RunAudits(const ServiceContext& context, ServiceResult& result);
// service_load.cc
absl::Status RunStragglers(const ServiceContext& context, ServiceResult& result);
absl::Status RunBroadcast(const ServiceContext& context, ServiceResult& result);
absl::Status RunNetwork(const ServiceContext& context, ServiceResult& result);
absl::Status RunLoad(const ServiceContext& context, ServiceResult& result);
absl::Status RunCost(const ServiceContext& context, ServiceResult& result);

}  // namespace farpoint
