// What a kernel of kinetix_dist/models/kernels/cuda asks of CUDA, on a CPU: for tests, with one block at a time.
//
// Each thread of a block is a context of its own (ucontext). A thread runs until it waits for others: at __syncthreads,
// or where a warp does something together. Which one goes on is drawn at random, so that what a missing barrier lets
// happen does happen in some run. Copies to shared memory arrive when they are waited for, not before. Shared memory is
// full of NaN at the start.

#pragma once

#include <ucontext.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <functional>
#include <random>
#include <utility>
#include <vector>

using std::max;
using std::min;
typedef unsigned int u32;
struct alignas(16) uint4 { u32 x, y, z, w; };
struct alignas(8) uint2 { u32 x, y; };
struct alignas(8) float2 { float x, y; };
struct alignas(16) float4 { float x, y, z, w; };
inline uint4 make_uint4(u32 x, u32 y, u32 z, u32 w) { return {x, y, z, w}; }
inline uint2 make_uint2(u32 x, u32 y) { return {x, y}; }
inline float4 make_float4(float x, float y, float z, float w) { return {x, y, z, w}; }
inline float2 make_float2(float x, float y) { return {x, y}; }
struct Index { int x; };

#define __global__
#define __device__
#define __forceinline__ inline
#define __launch_bounds__(...)
#define SHARED_MEMORY(type, name) type& name = *(type*)on_cpu::shared

namespace on_cpu {

constexpr int LANES = 32, SHARED_BYTES = 227 * 1024, STACK_BYTES = 128 * 1024;
inline char* shared;  // at 256 bytes
inline int shared_bytes;

struct Copy { char* to; uint4 content; };
struct Thread {
  ucontext_t context;
  std::vector<char> stack;
  std::vector<Copy> begun;               // of the group that has not ended
  std::vector<std::vector<Copy>> groups;  // under way
  int waits_for = 0;         // 0: nothing, 1: its warp, 2: its block
  bool is_done = false;
  void* given = nullptr;     // for what its warp does together
};
inline std::vector<Thread> threads;
inline ucontext_t scheduler;
inline int current;
inline std::function<void()> body;
inline std::mt19937 random_numbers(0);

[[noreturn]] inline void fail(const char* why) {
  std::fprintf(stderr, "%s\n", why);
  std::abort();
}

inline void wait(int what) {
  threads[current].waits_for = what;
  swapcontext(&threads[current].context, &scheduler);
}

// All lanes of a warp give something; the last one to come does `work` with what all gave.
template <typename Work>
void together(void* given, Work work) {
  const int first = current / LANES * LANES;
  threads[current].given = given;
  int waiting = 0;
  for (int i = first; i < first + LANES; ++i) waiting += i == current || threads[i].waits_for == 1;
  if (waiting < LANES) return wait(1);
  void* of_lanes[LANES];
  for (int i = 0; i < LANES; ++i) of_lanes[i] = threads[first + i].given;
  work(of_lanes);
  for (int i = first; i < first + LANES; ++i) threads[i].waits_for = 0;
}

inline void start() {
  body();
  threads[current].is_done = true;
  swapcontext(&threads[current].context, &scheduler);
}

}  // namespace on_cpu

inline Index threadIdx, blockIdx, gridDim;

namespace on_cpu {

inline void run_block(int num_threads) {
  threads.assign(num_threads, {});
  for (auto& thread : threads) {
    thread.stack.resize(STACK_BYTES);
    getcontext(&thread.context);
    thread.context.uc_stack.ss_sp = thread.stack.data();
    thread.context.uc_stack.ss_size = thread.stack.size();
    makecontext(&thread.context, start, 0);
  }
  std::vector<int> ready;
  while (true) {
    ready.clear();
    int done = 0, at_barrier = 0;
    for (int i = 0; i < num_threads; ++i) {
      done += threads[i].is_done;
      at_barrier += threads[i].waits_for == 2;
      if (!threads[i].is_done && threads[i].waits_for == 0) ready.push_back(i);
    }
    if (done == num_threads) return;
    if (ready.empty()) {
      if (at_barrier + done < num_threads || done) fail("threads of a block wait for different things");
      for (auto& thread : threads) thread.waits_for = 0;
      continue;
    }
    std::shuffle(ready.begin(), ready.end(), random_numbers);
    for (int i : ready) {
      if (threads[i].waits_for || threads[i].is_done) continue;
      current = i;
      threadIdx.x = i;
      swapcontext(&scheduler, &threads[i].context);
    }
  }
}

template <typename... Arguments, size_t... I>
void call(void (*kernel)(Arguments...), void** given, std::index_sequence<I...>) {
  kernel((Arguments)given[I]...);
}

// Every block of a grid, one after another.
template <typename... Arguments>
void launch(void (*kernel)(Arguments...), int grid, int num_threads, int bytes, void** given) {
  if (bytes > SHARED_BYTES) fail("more shared memory is asked for than a block can have");
  static std::vector<char> memory(SHARED_BYTES + 512);
  shared = (char*)(((uintptr_t)memory.data() + 255) / 256 * 256);
  shared_bytes = bytes;
  gridDim.x = grid;
  for (int block = 0; block < grid; ++block) {
    blockIdx.x = block;
    std::memset(shared, 0xff, SHARED_BYTES);
    body = [=] { call(kernel, given, std::index_sequence_for<Arguments...>{}); };
    run_block(num_threads);
    for (int i = bytes; i < SHARED_BYTES; ++i)
      if ((unsigned char)shared[i] != 0xff) fail("more shared memory is written than was asked for");
  }
}

inline float from_bits(u32 bits) {
  float x;
  std::memcpy(&x, &bits, 4);
  return x;
}

inline u32 bfloat16_bits(float x) {
  u32 bits;
  std::memcpy(&bits, &x, 4);
  if (std::isnan(x)) return 0x7fc0;
  return (bits + 0x7fff + (bits >> 16 & 1)) >> 16;
}

inline float number(const u32* words, int i) { return from_bits(words[i / 2] >> (i % 2 * 16) << 16); }

}  // namespace on_cpu

inline int __ffs(u32 bits) { return __builtin_ffs((int)bits); }
inline void atomicOr(u32* word, u32 bits) { *word |= bits; }
inline void __syncthreads() { on_cpu::wait(2); }
inline float __uint_as_float(u32 bits) { return on_cpu::from_bits(bits); }
inline float rsqrtf(float x) { return 1.0f / std::sqrt(x); }
inline u32 pack(float low, float high) { return on_cpu::bfloat16_bits(low) | on_cpu::bfloat16_bits(high) << 16; }
inline float power_of_2(float x) { return std::exp2(x); }
inline float reciprocal(float x) { return 1.0f / x; }
inline float logarithm_to_2(float x) { return std::log2(x); }
inline u32 shared_address(const char* place) { return (u32)(place - on_cpu::shared); }

inline void copy_async(char* to, const uint4* from, bool is_there) {
  on_cpu::threads[on_cpu::current].begun.push_back({to, is_there ? *from : uint4{0, 0, 0, 0}});
}

inline void end_group() {
  auto& own = on_cpu::threads[on_cpu::current];
  own.groups.push_back(std::move(own.begun));
  own.begun.clear();
}

template <int N>
void wait_for_copies() {
  auto& groups = on_cpu::threads[on_cpu::current].groups;
  while (groups.size() > N) {
    for (const auto& copy : groups.front()) *(uint4*)copy.to = copy.content;
    groups.erase(groups.begin());
  }
}

inline float from_lane(float x, int flipped) {
  struct Given { float x, result; int flipped; } own{x, 0.0f, flipped};
  on_cpu::together(&own, [](void** lanes) {
    for (int i = 0; i < on_cpu::LANES; ++i) {
      auto* to = (Given*)lanes[i];
      to->result = ((Given*)lanes[i ^ to->flipped])->x;
    }
  });
  return own.result;
}

namespace on_cpu {

// Four matrices of 8 x 8: lanes 8 i to 8 i + 7 give the addresses of the rows of matrix i. Lane l gets of each the two
// numbers of row l / 4 from column 2 (l % 4) on; of the transposed matrix where `is_transposed`.
inline void read_matrices(u32 (&r)[4], u32 address, bool is_transposed) {
  struct Given { u32 address; u32* r; bool is_transposed; } own{address, r, is_transposed};
  if (address % 16 || (int)address + 16 > shared_bytes) fail("an address of ldmatrix that is none");
  together(&own, [](void** lanes) {
    for (int i = 0; i < 4; ++i)
      for (int lane = 0; lane < LANES; ++lane) {
        auto* to = (Given*)lanes[lane];
        uint16_t found[2];
        for (int j = 0; j < 2; ++j) {
          const int row = lane / 4, column = 2 * (lane % 4) + j;
          const int stored_row = to->is_transposed ? column : row, stored_column = to->is_transposed ? row : column;
          const auto* from = (const uint16_t*)(shared + ((Given*)lanes[8 * i + stored_row])->address);
          found[j] = from[stored_column];
        }
        to->r[i] = found[0] | (u32)found[1] << 16;
      }
  });
}

}  // namespace on_cpu

inline void ldmatrix(u32 (&r)[4], u32 address) { on_cpu::read_matrices(r, address, false); }
inline void ldmatrix_trans(u32 (&r)[4], u32 address) { on_cpu::read_matrices(r, address, true); }

// PTX, "Matrix fragments for mma.m16n8k16 with floating point type". A: words 0 and 1 are of rows l / 4 and l / 4 + 8,
// columns 2 (l % 4) and the next; 2 and 3 of the same rows, eight columns further. B: word 0 has rows 2 (l % 4) and the
// next of column l / 4, word 1 those eight further.
inline void mma(float (&c)[4], const u32 (&a)[4], u32 b0, u32 b1) {
  struct Given { float* c; const u32* a; u32 b[2]; } own{c, a, {b0, b1}};
  on_cpu::together(&own, [](void** lanes) {
    float of_a[16][16], of_b[16][8];
    for (int lane = 0; lane < on_cpu::LANES; ++lane) {
      auto* own = (Given*)lanes[lane];
      for (int word = 0; word < 4; ++word)
        for (int j = 0; j < 2; ++j)
          of_a[lane / 4 + word % 2 * 8][2 * (lane % 4) + j + word / 2 * 8] = on_cpu::number(own->a, 2 * word + j);
      for (int word = 0; word < 2; ++word)
        for (int j = 0; j < 2; ++j)
          of_b[2 * (lane % 4) + j + word * 8][lane / 4] = on_cpu::number(own->b, 2 * word + j);
    }
    for (int lane = 0; lane < on_cpu::LANES; ++lane)
      for (int i = 0; i < 4; ++i) {
        const int row = lane / 4 + i / 2 * 8, column = 2 * (lane % 4) + i % 2;
        for (int k = 0; k < 16; ++k) ((Given*)lanes[lane])->c[i] += of_a[row][k] * of_b[k][column];
      }
  });
}
