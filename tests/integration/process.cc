#include "tests/integration/process.h"

#include <fcntl.h>
#include <signal.h>
#include <sys/prctl.h>
#include <sys/wait.h>
#include <unistd.h>

#include <cstdio>
#include <cstdlib>

namespace farpoint {

Process::Process(const std::vector<std::string>& args, const std::string& out,
                 const std::string& err, const std::map<std::string, std::string>& environment) {
  std::vector<char*> argv;
  for (const std::string& arg : args) argv.push_back(const_cast<char*>(arg.c_str()));
  argv.push_back(nullptr);
  const pid_t parent = getpid();
  pid_ = fork();
  if (pid_ < 0) {
    std::perror("fork");
    std::abort();
  }
  if (pid_ > 0) return;
  // The child. It dies with the test program, however that ends.
  prctl(PR_SET_PDEATHSIG, SIGKILL);
  if (getppid() != parent) _exit(126);
  const int out_file = open(out.c_str(), O_WRONLY | O_CREAT | O_APPEND, 0600);
  const int err_file = open(err.c_str(), O_WRONLY | O_CREAT | O_APPEND, 0600);
  const int in_file = open("/dev/null", O_RDONLY);
  if (out_file < 0 || err_file < 0 || in_file < 0) _exit(126);
  dup2(in_file, STDIN_FILENO);
  dup2(out_file, STDOUT_FILENO);
  dup2(err_file, STDERR_FILENO);
  unsetenv("FARPOINT_COORDINATOR");
  for (const auto& [name, value] : environment) setenv(name.c_str(), value.c_str(), 1);
  execv(argv[0], argv.data());
  std::fprintf(stderr, "cannot start %s\n", argv[0]);
  _exit(127);
}

Process::~Process() {
  if (exit_code_) return;
  kill(pid_, SIGKILL);
  Reap(true);
}

void Process::Reap(bool block) {
  if (exit_code_) return;
  int status = 0;
  if (waitpid(pid_, &status, block ? 0 : WNOHANG) != pid_) return;
  exit_code_ = WIFEXITED(status) ? WEXITSTATUS(status) : 128 + WTERMSIG(status);
}

void Process::Signal(int signal) {
  Reap(false);
  if (!exit_code_) kill(pid_, signal);
}

bool Process::Running() {
  Reap(false);
  return !exit_code_;
}

std::optional<int> Process::Wait(std::chrono::milliseconds time) {
  WaitUntil(time, [&] { return !Running(); });
  return exit_code_;
}

}  // namespace farpoint
