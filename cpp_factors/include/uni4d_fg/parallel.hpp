// Threads over fixed ranges: which worker does what depends on (count, threads) alone, so that sums taken in the
// order of the workers are the same from run to run.
#pragma once

#include <algorithm>
#include <exception>
#include <thread>
#include <vector>

namespace uni4d_fg {

/// Number of workers for a request: the cores when 0, never more than `most`, at least 1.
inline int resolve_threads(int requested, int most = 256) {
  int threads = requested > 0 ? requested : static_cast<int>(std::thread::hardware_concurrency());
  return std::max(1, std::min(threads, most));
}

/// First index of a worker's range when [0, count) is cut into `workers` ranges of nearly equal length.
inline int range_begin(int count, int workers, int worker) {
  return static_cast<int>(static_cast<long long>(count) * worker / workers);
}

/// Call f(begin, end, worker) once per worker on disjoint ranges that cover [0, count); worker 0 is the caller.
/// `threads` is the number of workers (at least 1); fewer run when count is smaller. The first exception is rethrown.
template <typename F>
void parallel_for(int count, int threads, F f) {
  const int workers = std::max(1, std::min(threads, count));
  if (workers == 1) {
    if (count > 0) f(0, count, 0);
    return;
  }
  std::vector<std::exception_ptr> errors(static_cast<std::size_t>(workers));
  auto work = [&](int worker) {
    try {
      f(range_begin(count, workers, worker), range_begin(count, workers, worker + 1), worker);
    } catch (...) {
      errors[static_cast<std::size_t>(worker)] = std::current_exception();
    }
  };
  std::vector<std::thread> pool;
  pool.reserve(static_cast<std::size_t>(workers - 1));
  try {
    for (int worker = 1; worker < workers; ++worker) pool.emplace_back(work, worker);
  } catch (...) {
    // No more threads to be had: the caller does what was not started.
    for (int worker = static_cast<int>(pool.size()) + 1; worker < workers; ++worker) work(worker);
  }
  work(0);
  for (std::thread& thread : pool) thread.join();
  for (const std::exception_ptr& error : errors)
    if (error) std::rethrow_exception(error);
}

/// Workers worth starting for `count` items when a thread should have at least `grain` of them.
inline int useful_threads(int threads, int count, int grain) {
  return std::max(1, std::min(threads, count / std::max(grain, 1)));
}

}  // namespace uni4d_fg
