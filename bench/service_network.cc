#include "bench/service_network.h"

#include <unistd.h>

#include <cstdlib>

namespace farpoint {

namespace {

bool Shell(const std::string& command) {
  return std::system(("{ " + command + "; } >/dev/null 2>&1").c_str()) == 0;
}

absl::Status NotPermitted() {
  return absl::UnavailableError("network namespaces are not permitted here (run as root)");
}

}  // namespace

std::string NetworkSpace::host() const { return "10.213." + std::to_string(index_) + ".1"; }

absl::StatusOr<std::unique_ptr<NetworkSpace>> NetworkSpace::Create(int index, int mbit_per_second) {
  // Names of interfaces have at most 15 characters.
  const std::string name = "fp" + std::to_string(::getpid() % 100000) + "n" + std::to_string(index);
  auto space = std::unique_ptr<NetworkSpace>(new NetworkSpace(index, name));
  const std::string near = name + "a", far = name + "b";
  const std::string there = "10.213." + std::to_string(index) + ".2";
  if (!Shell("ip netns add " + name) ||
      !Shell("ip link add " + near + " type veth peer name " + far) ||
      !Shell("ip link set " + far + " netns " + name) ||
      !Shell("ip addr add " + space->host() + "/24 dev " + near + " && ip link set " + near +
             " up") ||
      !Shell("ip netns exec " + name + " sh -c 'ip addr add " + there + "/24 dev " + far +
             " && ip link set " + far + " up && ip link set lo up'")) {
    return NotPermitted();
  }
  if (mbit_per_second > 0 &&
      !Shell("tc qdisc add dev " + near + " root tbf rate " + std::to_string(mbit_per_second) +
             "mbit burst 64kb latency 100ms")) {
    return NotPermitted();
  }
  return space;
}

NetworkSpace::~NetworkSpace() {
  (void)Shell("ip netns del " + name_);
  (void)Shell("ip link del " + name_ + "a");
}

absl::Status NetworkSpace::TakeDown() {
  return Shell("ip link set " + name_ + "a down") ? absl::OkStatus() : NotPermitted();
}

absl::Status NetworkSpace::DropAll() {
  // A queue that holds nothing.
  return Shell("tc qdisc replace dev " + name_ + "a root pfifo limit 0") ? absl::OkStatus()
                                                                         : NotPermitted();
}

}  // namespace farpoint
