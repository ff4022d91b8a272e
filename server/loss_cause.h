// Why leases are lost, for scheduler, log and metrics.
#pragma once

namespace farpoint {

// Why a lease ended without a result that counts.
enum class LossCause {
  kReported,      // the worker said so, or its result was damaged
  kDisconnected,  // reconnect_time
  kSilent,        // silence_time
  kNoProgress,    // lease_time
  kHung,          // stall_time: neither progress nor processor time, or no step
};

}  // namespace farpoint
