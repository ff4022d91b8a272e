// A name's addresses.
#pragma once

#include <netdb.h>

#include <memory>
#include <string_view>

#include "core/base/status.h"

namespace farpoint {

enum class ResolveFor { kConnecting, kListening };

struct AddressListDeleter {
  void operator()(addrinfo* list) const { ::freeaddrinfo(list); }
};
// At least one; the next ones by ai_next.
using AddressList = std::unique_ptr<addrinfo, AddressListDeleter>;

// Those of `address` (HOST:PORT, see SplitHostPort) for streams, IPv4 and IPv6, the likeliest
// first. Blocks for as long as the name server takes. kUnavailable: "the name 'HOST' does not
// resolve (why)" or "'PORT' is not a port"; what to do is for the caller to add. Thread-safe.
absl::StatusOr<AddressList> Resolve(std::string_view address,
                                    ResolveFor use = ResolveFor::kConnecting);

}  // namespace farpoint
