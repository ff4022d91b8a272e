// Traps of floating-point exceptions: in a debug build the process gets SIGFPE at the operation
// that makes the first NaN or infinity, and not where an image turns out to have one.
//
// Executor sets one around every body that it runs, so all parallel kernels are under it. A kernel
// that divides by zero in lanes that it then leaves out, and every call into a library that was not
// built for it (Embree, image decoders), stands under an FpTrapPause. In other builds
// (FARPOINT_TRAP_FP is not defined) both do nothing: compilers there may speculate such operations.
#pragma once

#ifdef FARPOINT_TRAP_FP
#include <fenv.h>
#endif

namespace farpoint {

#ifdef FARPOINT_TRAP_FP
inline constexpr bool kTrapsFp = true;

// For this thread, as long as it lives: invalid operations, divisions by zero and overflows raise
// SIGFPE. Nests.
class FpTrap {
 public:
  FpTrap() : before_(fegetexcept()) {
    feclearexcept(FE_ALL_EXCEPT);
    feenableexcept(FE_INVALID | FE_DIVBYZERO | FE_OVERFLOW);
  }
  ~FpTrap() { Restore(before_); }
  FpTrap(const FpTrap&) = delete;
  FpTrap& operator=(const FpTrap&) = delete;

  static void Restore(int traps) {
    feclearexcept(FE_ALL_EXCEPT);
    fedisableexcept(FE_ALL_EXCEPT);
    feenableexcept(traps);
  }

 private:
  int before_;
};

// For this thread, as long as it lives: nothing is trapped.
class FpTrapPause {
 public:
  FpTrapPause() : before_(fedisableexcept(FE_ALL_EXCEPT)) {}
  ~FpTrapPause() { FpTrap::Restore(before_); }
  FpTrapPause(const FpTrapPause&) = delete;
  FpTrapPause& operator=(const FpTrapPause&) = delete;

 private:
  int before_;
};
#else
inline constexpr bool kTrapsFp = false;

class FpTrap {
 public:
  FpTrap() {}
  ~FpTrap() {}
};
class FpTrapPause {
 public:
  FpTrapPause() {}
  ~FpTrapPause() {}
};
#endif

}  // namespace farpoint
