// A team of threads that meet at barriers: for loops whose steps are too short to start threads for each.
#pragma once

#include <atomic>
#include <thread>
#include <vector>

namespace uni4d_fg {

/// Barrier and identity of the members; every member must call `wait` equally often.
class ThreadTeam {
 public:
  int size() const { return size_; }

  /// Return when all members have called. Spins briefly and then yields, so that a busy machine is not blocked.
  void wait() {
    if (size_ == 1) return;
    const int phase = phase_.load(std::memory_order_acquire);
    if (arrived_.fetch_add(1, std::memory_order_acq_rel) + 1 == size_) {
      arrived_.store(0, std::memory_order_relaxed);
      phase_.store(phase + 1, std::memory_order_release);
      return;
    }
    for (int spins = 0; phase_.load(std::memory_order_acquire) == phase; ++spins) {
      if (spins > kSpins) std::this_thread::yield();
    }
  }

  /// Call f(worker, team) on up to `threads` threads, the caller being worker 0. f must not throw.
  template <typename F>
  static void run(int threads, F f) {
    ThreadTeam team;
    std::vector<std::thread> members;
    std::atomic<int> size{0};  // unknown until all that can be had have started
    try {
      for (int worker = 1; worker < threads; ++worker) {
        members.emplace_back([&, worker] {
          while (size.load(std::memory_order_acquire) == 0) std::this_thread::yield();
          f(worker, team);
        });
      }
    } catch (...) {
      // No more threads to be had: a smaller team.
    }
    team.size_ = static_cast<int>(members.size()) + 1;
    size.store(team.size_, std::memory_order_release);
    f(0, team);
    for (std::thread& member : members) member.join();
  }

 private:
  static constexpr int kSpins = 4000;
  int size_ = 1;
  std::atomic<int> arrived_{0}, phase_{0};
};

}  // namespace uni4d_fg
