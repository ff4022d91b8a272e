#include "proto/resolve.h"

#include <sys/socket.h>

#include <string>

#include "proto/access.h"

namespace farpoint {

absl::StatusOr<AddressList> Resolve(std::string_view address, ResolveFor use) {
  const HostPort parts = SplitHostPort(address);
  addrinfo hints{};
  hints.ai_family = AF_UNSPEC;
  hints.ai_socktype = SOCK_STREAM;
  if (use == ResolveFor::kListening) hints.ai_flags = AI_PASSIVE;
  addrinfo* list = nullptr;
  const int error = ::getaddrinfo(parts.host.c_str(), parts.port.c_str(), &hints, &list);
  if (error == EAI_SERVICE) {
    return absl::UnavailableError("'" + parts.port + "' is not a port");
  }
  if (error != 0 || list == nullptr) {
    return absl::UnavailableError("the name '" + parts.host + "' does not resolve (" +
                                  (error != 0 ? ::gai_strerror(error) : "no address") + ")");
  }
  return AddressList(list);
}

}  // namespace farpoint
