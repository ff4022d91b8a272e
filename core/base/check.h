// FP_CHECK: an invariant of our own code is broken, the process stops with file and line.
// Never for what comes from a file or a peer (that is absl::Status). FP_DCHECK is for kernels and
// costs nothing in release builds.
#pragma once

namespace farpoint {

// Prints "file:line: check failed: text" to stderr and aborts.
[[noreturn]] void CheckFailed(const char* file, int line, const char* text);

}  // namespace farpoint

#define FP_CHECK(cond) \
  ((cond) ? static_cast<void>(0) : ::farpoint::CheckFailed(__FILE__, __LINE__, #cond))
#ifdef NDEBUG
#define FP_DCHECK(cond) static_cast<void>(0)
#else
#define FP_DCHECK(cond) FP_CHECK(cond)
#endif
