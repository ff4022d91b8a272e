// Linked into the programs: says that a processor will not do, before the first instruction that it
// does not know ends the process without a word. Compiled for any x86-64.
#include <sys/platform/x86.h>
#include <unistd.h>

#include <cstring>

namespace {

// core/base/status.h: trying again will not help.
constexpr int kExitPermanent = 42;

// Before every other initialisation of the program.
[[gnu::constructor(101)]] void CheckProcessor() {
  const char* missing = nullptr;
  if (!CPU_FEATURE_ACTIVE(F16C)) missing = "F16C";
  if (!CPU_FEATURE_ACTIVE(BMI2)) missing = "BMI2";
  if (!CPU_FEATURE_ACTIVE(FMA)) missing = "FMA";
  if (!CPU_FEATURE_ACTIVE(AVX2)) missing = "AVX2";
  if (missing == nullptr) return;
  const auto say = [](const char* text) { (void)!::write(STDERR_FILENO, text, std::strlen(text)); };
  say("farpoint: error: this processor has no ");
  say(missing);
  say(", which pixels are computed with; take a machine of 2013 or later, or let the virtual "
      "machine "
      "pass its processor through\n");
  ::_exit(kExitPermanent);
}

}  // namespace
