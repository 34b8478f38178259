#include "parallel.h"

#include <algorithm>
#include <atomic>
#include <condition_variable>
#include <mutex>
#include <thread>
#include <vector>

namespace splatctrl {
namespace {

// Workers sleep between jobs. One job at a time; a second caller waits its turn. A caller waits for the workers that
// have begun, not for those that have not woken up by the time all chunks are handed out: on a busy machine, and for
// short jobs, that is most of the time.
class Pool {
 public:
  void run(int num_chunks, int num_threads, const std::function<void(int)>& fn) {
    const std::lock_guard<std::mutex> turn(turn_);
    const int num_wanted = std::min(num_threads, num_chunks) - 1;
    grow(num_wanted);
    next_.store(0);
    {
      const std::lock_guard<std::mutex> lock(mutex_);
      fn_ = &fn;
      num_chunks_ = num_chunks;
      num_wanted_ = num_wanted;
      is_open_ = true;
      ++generation_;
    }
    for (int worker = 0; worker < num_wanted; ++worker) wake_.notify_one();
    work(fn, num_chunks);
    std::unique_lock<std::mutex> lock(mutex_);
    is_open_ = false;
    done_.wait(lock, [this] { return num_running_ == 0; });
  }

 private:
  void grow(int num_workers) {
    while (static_cast<int>(workers_.size()) < num_workers) {
      workers_.emplace_back([this] { loop(); });
      workers_.back().detach();
    }
  }

  void work(const std::function<void(int)>& fn, int num_chunks) {
    for (int chunk = next_.fetch_add(1); chunk < num_chunks; chunk = next_.fetch_add(1)) fn(chunk);
  }

  void loop() {
    long seen = 0;
    for (;;) {
      std::unique_lock<std::mutex> lock(mutex_);
      wake_.wait(lock, [&] { return generation_ != seen && num_wanted_ > 0; });
      seen = generation_;
      if (!is_open_) continue;
      --num_wanted_;
      ++num_running_;
      const auto* fn = fn_;
      const int num_chunks = num_chunks_;
      lock.unlock();
      work(*fn, num_chunks);
      lock.lock();
      if (--num_running_ == 0) done_.notify_one();
    }
  }

  std::mutex turn_, mutex_;
  std::condition_variable wake_, done_;
  std::vector<std::thread> workers_;
  std::atomic<int> next_{0};
  const std::function<void(int)>* fn_ = nullptr;
  int num_chunks_ = 0, num_wanted_ = 0, num_running_ = 0;
  bool is_open_ = false;
  long generation_ = 0;
};

Pool& pool() {
  static Pool* const instance = new Pool;  // never destroyed: its threads may outlive static destruction
  return *instance;
}

}  // namespace

void parallel_for(int num_chunks, int num_threads, const std::function<void(int)>& fn) {
  if (num_threads <= 1 || num_chunks <= 1) {
    for (int chunk = 0; chunk < num_chunks; ++chunk) fn(chunk);
    return;
  }
  pool().run(num_chunks, num_threads, fn);
}

}  // namespace splatctrl
