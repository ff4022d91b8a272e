// A network namespace with one link to this machine, for a process that is to be far away. Needs
// the rights of root and the programs ip and tc.
#pragma once

#include <memory>
#include <string>

#include "core/base/status.h"

namespace farpoint {

class NetworkSpace {
 public:
  // `index` 0 to 200, different for those that live at a time. `mbit_per_second` limits what goes
  // to the namespace; 0: no limit. kUnavailable if it is not permitted here.
  static absl::StatusOr<std::unique_ptr<NetworkSpace>> Create(int index, int mbit_per_second);
  ~NetworkSpace();

  const std::string& name() const { return name_; }
  std::string host() const;  // this machine's address, seen from there

  // The interface goes down, or every packet to the namespace is dropped.
  absl::Status TakeDown();
  absl::Status DropAll();

 private:
  NetworkSpace(int index, std::string name) : index_(index), name_(std::move(name)) {}

  const int index_;
  const std::string name_;
};

}  // namespace farpoint
