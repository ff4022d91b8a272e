// What reads bytes that the project did not make: each reader as a function of bytes that a fuzzer
// can call, with seeds that the project's own writers made.
//
// A target must come back from any bytes: refusing them is right, crashing, hanging and taking
// memory that the bytes do not account for are not. Where a reader accepts, the target goes on:
// what was read must survive what is done with it. Targets abort with a line on stderr where a
// promise of a header is broken.
#pragma once

#include <cstddef>
#include <span>
#include <string_view>
#include <vector>

namespace farpoint {

using FuzzBytes = std::vector<std::byte>;

struct FuzzTarget {
  std::string_view name;  // [a-z_]+
  // True if the bytes were accepted. Seeds are.
  bool (*run)(std::span<const std::byte> bytes);
  std::vector<FuzzBytes> (*seeds)();
};

// Readers of core: scenes, images, blobs.
std::span<const FuzzTarget> CoreFuzzTargets();
// Readers of the service: job files, messages, configuration. Linked only where it is built.
std::span<const FuzzTarget> WireFuzzTargets();

// Ends the process with `what` unless `holds`.
void FuzzRequire(bool holds, const char* what);

FuzzBytes BytesOf(std::string_view text);
inline std::string_view TextOf(std::span<const std::byte> bytes) {
  return {reinterpret_cast<const char*>(bytes.data()), bytes.size()};
}

}  // namespace farpoint
