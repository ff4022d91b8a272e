// The entry of libFuzzer for one target, named by the definition FARPOINT_FUZZ_TARGET.
#include <cstdint>
#include <cstdlib>

#include "tests/fuzz/fuzz_target.h"

namespace {

const farpoint::FuzzTarget& Target() {
#ifdef FARPOINT_FUZZ_WIRE
  const auto targets = farpoint::WireFuzzTargets();
#else
  const auto targets = farpoint::CoreFuzzTargets();
#endif
  for (const farpoint::FuzzTarget& target : targets) {
    if (target.name == FARPOINT_FUZZ_TARGET) return target;
  }
  std::abort();
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
  static const farpoint::FuzzTarget& target = Target();
  target.run(std::as_bytes(std::span(data, size)));
  return 0;
}
