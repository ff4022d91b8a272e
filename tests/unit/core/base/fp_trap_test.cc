#include "core/base/fp_trap.h"

#include <gtest/gtest.h>

#include <cmath>
#include <csignal>
#include <limits>

#include "core/base/executor.h"

namespace farpoint {
namespace {

// Numbers that the compiler does not know.
volatile float zero = 0.0f, huge = std::numeric_limits<float>::max(), result = 0.0f;

void Invalid() { result = zero / zero; }
void DivideByZero() { result = 1.0f / zero; }
void Overflow() { result = huge * huge; }

using Operation = void (*)();
constexpr Operation kOperations[] = {Invalid, DivideByZero, Overflow};

// Sanitizers report these operations themselves, and take SIGFPE for their own.
#ifdef __SANITIZE_ADDRESS__
constexpr bool kSanitized = true;
#else
constexpr bool kSanitized = false;
#endif

TEST(FpTrapDeathTest, EndsTheProcessWhereBuildsTrap) {
  if (kSanitized) GTEST_SKIP() << "the sanitizer ends the process first";
  testing::GTEST_FLAG(death_test_style) = "threadsafe";
  for (const Operation operation : kOperations) {
    if (kTrapsFp) {
      EXPECT_EXIT(
          {
            const FpTrap trap;
            operation();
          },
          testing::KilledBySignal(SIGFPE), "");
    } else {
      const FpTrap trap;
      operation();
      EXPECT_FALSE(std::isfinite(result));
    }
  }
}

TEST(FpTrapDeathTest, CoversWhatAnExecutorRuns) {
  testing::GTEST_FLAG(death_test_style) = "threadsafe";
  if (!kTrapsFp || kSanitized) GTEST_SKIP() << "this build does not trap, or is sanitized";
  for (const unsigned threads : {1u, 2u}) {
    EXPECT_EXIT(
        {
          Executor executor(threads);
          executor.ForEach(8, 1, [](size_t i) {
            if (i == 3) DivideByZero();
          });
        },
        testing::KilledBySignal(SIGFPE), "");
  }
}

TEST(FpTrap, PausesAndEndsWithItsScope) {
  if (kSanitized) GTEST_SKIP() << "the sanitizer reports divisions by zero, trapped or not";
  {
    const FpTrap trap;
    {
      const FpTrapPause pause;
      for (const Operation operation : kOperations) operation();
    }
    {
      const FpTrap again;
      const FpTrapPause pause;
      Invalid();
    }
    result = 1.0f / 3.0f;  // inexact is no fault, and nothing pending is raised late
  }
  for (const Operation operation : kOperations) operation();
  EXPECT_FALSE(std::isfinite(result));
}

}  // namespace
}  // namespace farpoint
