// Chunks of work on a few threads. Callers fix the chunks, and sum over them in chunk order: the thread count
// never shows in the result.
#pragma once

#include <functional>

namespace splatctrl {

// Runs fn(chunk) for chunk in [0, num_chunks), each exactly once, on up to num_threads threads (the caller is one
// of them). Chunks are handed out in order, one at a time. fn must not throw.
void parallel_for(int num_chunks, int num_threads, const std::function<void(int)>& fn);

}  // namespace splatctrl
