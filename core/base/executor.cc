#include "core/base/executor.h"

#include <sched.h>
#include <tbb/blocked_range.h>
#include <tbb/parallel_for.h>
#include <tbb/task_arena.h>

#include <algorithm>

namespace farpoint {

namespace {

unsigned UsableCores() {
  cpu_set_t set;
  CPU_ZERO(&set);
  if (::sched_getaffinity(0, sizeof(set), &set) != 0) return 1;
  return static_cast<unsigned>(std::max(1, CPU_COUNT(&set)));
}

}  // namespace

struct Executor::Impl {
  // More threads than cores would only wait for each other, and oneTBB grants none (it says so on
  // stderr).
  explicit Impl(unsigned threads) : arena(static_cast<int>(std::min(threads, UsableCores()))) {}
  tbb::task_arena arena;
};

Executor::Executor(unsigned threads)
    : threads_(threads == 0 ? UsableCores() : threads), impl_(std::make_unique<Impl>(threads_)) {}

Executor::~Executor() = default;

void Executor::ForEach(size_t count, size_t grain, const std::function<void(size_t)>& body) {
  if (count == 0) return;
  if (threads_ == 1) {
    for (size_t i = 0; i < count; ++i) body(i);
    return;
  }
  impl_->arena.execute([&] {
    tbb::parallel_for(tbb::blocked_range<size_t>(0, count, std::max<size_t>(1, grain)),
                      [&](const tbb::blocked_range<size_t>& range) {
                        for (size_t i = range.begin(); i != range.end(); ++i) body(i);
                      });
  });
}

void Executor::ForEachPiece(size_t count, size_t piece,
                            const std::function<void(size_t begin, size_t end)>& body) {
  piece = std::max<size_t>(1, piece);
  const size_t pieces = (count + piece - 1) / piece;
  ForEach(pieces, 1, [&](size_t i) { body(i * piece, std::min(count, (i + 1) * piece)); });
}

}  // namespace farpoint
