#include "worker/crash_reporter.h"

#include <gtest/gtest.h>
#include <signal.h>
#include <sys/wait.h>
#include <unistd.h>

#include <cstdlib>
#include <string>
#include <thread>

namespace farpoint {
namespace {

#if defined(__SANITIZE_ADDRESS__) || defined(__SANITIZE_THREAD__)
constexpr bool kSanitized = true;
#else
constexpr bool kSanitized = false;
#endif

struct Death {
  std::string told;
  int status = 0;
};

// What a child says that ends by `die`, and how it ends.
template <typename Die>
Death DeathBy(Die die) {
  int words[2];
  EXPECT_EQ(::pipe(words), 0);
  const pid_t child = ::fork();
  if (child == 0) {
    ::close(words[0]);
    const CrashReporter reporter([&](const std::string& cause) {
      if (::write(words[1], cause.data(), cause.size()) < 0) ::_exit(1);
    });
    std::thread(die).join();
    ::_exit(0);
  }
  ::close(words[1]);
  Death death;
  char byte = 0;
  while (::read(words[0], &byte, 1) == 1) death.told += byte;
  ::close(words[0]);
  ::waitpid(child, &death.status, 0);
  return death;
}

TEST(CrashReporter, TellsTheSignalAndDiesOfIt) {
  if (kSanitized) GTEST_SKIP() << "a sanitizer reports by itself";
  for (const int number : {SIGSEGV, SIGFPE, SIGABRT}) {
    const Death death = DeathBy([number] { ::raise(number); });
    EXPECT_EQ(death.told.substr(0, death.told.find(' ', 7)), "signal " + std::to_string(number));
    ASSERT_TRUE(WIFSIGNALED(death.status));
    EXPECT_EQ(WTERMSIG(death.status), number);
  }
}

TEST(CrashReporter, OfSeveralThreadsTheFirstTells) {
  if (kSanitized) GTEST_SKIP() << "a sanitizer reports by itself";
  const Death death = DeathBy([] {
    std::thread other([] { ::raise(SIGSEGV); });
    ::raise(SIGSEGV);
    other.join();
  });
  EXPECT_EQ(death.told.find("signal", 1), std::string::npos) << death.told;
  ASSERT_TRUE(WIFSIGNALED(death.status));
  EXPECT_EQ(WTERMSIG(death.status), SIGSEGV);
}

TEST(CrashReporter, SaysNothingWhereNothingHappens) {
  const Death death = DeathBy([] {});
  EXPECT_EQ(death.told, "");
  ASSERT_TRUE(WIFEXITED(death.status));
  EXPECT_EQ(WEXITSTATUS(death.status), 0);
}

}  // namespace
}  // namespace farpoint
