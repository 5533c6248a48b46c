// Messages of a layer along joints and from thrusters, all from the tokens before any is added:
//
//     x[from] += [x_from, x_to] W_joint + term       for each joint that exists, in either direction
//     x[owner] += x_owner W_thruster + term          for each thruster that exists
//
// and the gradient of x, of the terms and of both kernels. x is [worlds, TOKENS, 128] in bfloat16, the terms (the share
// of a joint or thruster itself) [worlds, JOINTS, 128] and [worlds, THRUSTERS, 128]. weights: [384, 128] in bfloat16,
// for x_from, x_to and x_owner. joints: [worlds, JOINTS], thrusters: [worlds, THRUSTERS], words of from (or owner) in
// bits 0 to 7, to in 8 to 15, and whether it exists in 16. Sums are float32; messages are rounded before they are added.
//
// Blocks work in pairs: both read the same worlds, each has one half of the columns of the result, so that its weights
// leave room for two blocks on a multiprocessor. Rows are gathered as `ldmatrix` reads them: each lane gives the address
// of its own row. The next tile, of WORLDS_A_TILE worlds, is on its way while one is worked on.

#include "tile.cuh"

#if !defined(TOKENS) || !defined(JOINTS) || !defined(THRUSTERS) || !defined(WORLDS_A_TILE)
#error "TOKENS, JOINTS and THRUSTERS of a world, and WORLDS_A_TILE"
#endif

constexpr int HALF = WIDTH / 2, HALF_CHUNKS = CHUNKS / 2;
constexpr int X_ROWS = WORLDS_A_TILE * TOKENS;
// Messages of a tile: joints of all worlds, then thrusters, each filled up to whole products of 16 rows.
constexpr int JOINT_ROWS = (WORLDS_A_TILE * JOINTS + 15) / 16 * 16;
constexpr int THRUSTER_ROWS = (WORLDS_A_TILE * THRUSTERS + 15) / 16 * 16;
constexpr int MESSAGES = JOINT_ROWS + THRUSTER_ROWS;
static_assert(MESSAGES <= THREADS, "a thread has one message at most");
static_assert(X_ROWS < 4096, "a row is twelve bits");

struct MessagesShared {
  char weights[3 * WIDTH * HALF_CHUNKS * 16];  // the own columns
  char tiles[2][X_ROWS * CHUNKS * 16];
  char told[2][MESSAGES * HALF_CHUNKS * 16];  // terms, then messages
  u32 ends[2][MESSAGES];
};

struct MessagesGradientShared {
  char weights[3 * HALF * CHUNKS * 16];  // rows: the own half of the numbers of x_from, x_to, x_owner
  char tiles[2][X_ROWS * CHUNKS * 16];
  char of_rows[(MESSAGES + JOINT_ROWS) * HALF_CHUNKS * 16];  // gradients of x_from, x_to, x_owner
  u32 ends[2][MESSAGES];
};

struct MessagesWeightGradientShared {
  char tiles[2][X_ROWS * CHUNKS * 16];
  char grads[2][X_ROWS * HALF_CHUNKS * 16];  // the own columns
  char zeros[HALF_CHUNKS * 16];
  u32 ends[2][MESSAGES];
};

SHARED_BYTES(messages, MessagesShared)
SHARED_BYTES(messages_gradient, MessagesGradientShared)
SHARED_BYTES(messages_weight_gradient, MessagesWeightGradientShared)

// The ends of a message: rows of the tile, and whether it exists.
__device__ __forceinline__ int from_of(u32 ends) { return ends & 0xfff; }
__device__ __forceinline__ int to_of(u32 ends) { return ends >> 12 & 0xfff; }
__device__ __forceinline__ bool exists(u32 ends) { return ends >> 24 & 1; }

// Where the messages of a tile are.
struct Numbers {
  // The message of a joint or thruster, k of its world.
  static __device__ __forceinline__ int of(int world, int k) {
    return k < JOINTS ? world * JOINTS + k : JOINT_ROWS + world * THRUSTERS + k - JOINTS;
  }
};

// The ends of the message that this thread has.
__device__ __forceinline__ u32 load_ends(const u32* joints, const u32* thrusters, int world, int worlds) {
  const bool is_joint = threadIdx.x < JOINT_ROWS;
  const int number = is_joint ? threadIdx.x : threadIdx.x - JOINT_ROWS, each = is_joint ? JOINTS : THRUSTERS;
  const int of_world = number / each;
  if (of_world >= WORLDS_A_TILE || world + of_world >= worlds) return 0u;
  const u32 word = (is_joint ? joints : thrusters)[(long long)world * each + number];
  const u32 first = of_world * TOKENS;
  return (first + (word & 255)) | (first + (word >> 8 & 255)) << 12 | (word >> 16 & 1) << 24;
}

// Begins to copy columns from piece `piece` on of rows into a tile with rows of ROW_CHUNKS pieces.
template <int ROW_CHUNKS, int NUM_ROWS>
__device__ __forceinline__ void begin_rows(char* tile, const uint4* rows, long long first, int num_rows, int piece) {
#pragma unroll
  for (int i = threadIdx.x; i < NUM_ROWS * ROW_CHUNKS; i += THREADS) {
    const int row = i / ROW_CHUNKS, chunk = i % ROW_CHUNKS;
    const bool is_there = row < num_rows;
    copy_async(tile + at<ROW_CHUNKS>(row, chunk), rows + (is_there ? (first + row) * CHUNKS + piece + chunk : 0), is_there);
  }
}

__device__ __forceinline__ void add_to(float (&total)[8], const uint4& piece) {
  const u32 words[4] = {piece.x, piece.y, piece.z, piece.w};
#pragma unroll
  for (int i = 0; i < 4; ++i) {
    total[2 * i] += low(words[i]);
    total[2 * i + 1] += high(words[i]);
  }
}

__device__ __forceinline__ uint4 packed(const float (&total)[8]) {
  return make_uint4(pack(total[0], total[1]), pack(total[2], total[3]), pack(total[4], total[5]), pack(total[6], total[7]));
}

// The tiles of a pair of blocks, one after another.
struct Tiles {
  int world = (blockIdx.x >> 1) * WORLDS_A_TILE, stride = (gridDim.x >> 1) * WORLDS_A_TILE, number = 0;

  __device__ __forceinline__ int stage() const { return number & 1; }
  __device__ __forceinline__ void advance() { world += stride, ++number; }
};

extern "C" __global__ void __launch_bounds__(THREADS, 2)
    messages(const int* num_worlds, const uint4* x, const u32* joints, const u32* thrusters, const uint4* joint_terms,
             const uint4* thruster_terms, const uint4* weights, uint4* out) {
  SHARED_MEMORY(MessagesShared, own);
  const int piece = (blockIdx.x & 1) * HALF_CHUNKS, worlds = *num_worlds;
  for (int i = threadIdx.x; i < 3 * WIDTH * HALF_CHUNKS; i += THREADS)
    *(uint4*)(own.weights + at<HALF_CHUNKS>(i / HALF_CHUNKS, i % HALF_CHUNKS)) =
        weights[i / HALF_CHUNKS * CHUNKS + piece + i % HALF_CHUNKS];

  const auto begin = [&](int stage, int world) {
    const int here = min(WORLDS_A_TILE, worlds - world);
    begin_rows<CHUNKS, X_ROWS>(own.tiles[stage], x, (long long)world * TOKENS, here * TOKENS, 0);
    begin_rows<HALF_CHUNKS, JOINT_ROWS>(own.told[stage], joint_terms, (long long)world * JOINTS, here * JOINTS, piece);
    begin_rows<HALF_CHUNKS, THRUSTER_ROWS>(own.told[stage] + JOINT_ROWS * HALF_CHUNKS * 16, thruster_terms,
                                           (long long)world * THRUSTERS, here * THRUSTERS, piece);
    end_group();
  };
  Tiles at_tile;
  begin(0, at_tile.world);
  u32 next = load_ends(joints, thrusters, at_tile.world, worlds);
  for (; at_tile.world < worlds; at_tile.advance()) {
    char *tile = own.tiles[at_tile.stage()], *told = own.told[at_tile.stage()];
    u32* ends = own.ends[at_tile.stage()];
    if (threadIdx.x < MESSAGES) ends[threadIdx.x] = next;
    wait_for_copies<0>();
    __syncthreads();  // with the tile before every thread is done
    begin(at_tile.stage() ^ 1, at_tile.world + at_tile.stride);
    next = load_ends(joints, thrusters, at_tile.world + at_tile.stride, worlds);

    // Sixteen messages and sixteen columns at a time.
    constexpr int GROUPS = HALF / 16;
    for (int unit = warp(); unit < MESSAGES / 16 * GROUPS; unit += WARPS) {
      const int m = unit / GROUPS * 16, n = unit % GROUPS * 16;
      const bool is_joint = m < JOINT_ROWS;
      const u32 end = ends[m + lane_row()];
      Sums<1, 2> sums;
      sums.clear();
      for (int part = 0; part < (is_joint ? 2 : 1); ++part) {
        const u32 from_a = of_a<CHUNKS>(tile, part == 0 ? from_of(end) : to_of(end));
        const u32 from_b =
            of_b_t<HALF_CHUNKS>(own.weights + (is_joint ? part : 2) * WIDTH * HALF_CHUNKS * 16, lane_row()) ^ 2 * n;
        sums.add<WIDTH>([&](u32 (&words)[4], int, int k) { ldmatrix(words, from_a ^ 2 * k); },
                        [&](u32 (&words)[4], int k, int) { ldmatrix_trans(words, from_b + k * HALF_CHUNKS * 16); });
      }
      sums.each_pair(m, n, [&](float one, float two, int row, int column) {
        u32* term = pair_at<HALF_CHUNKS>(told, row, column);
        *term = exists(ends[row]) ? pack(one + low(*term), two + high(*term)) : 0u;
      });
    }
    __syncthreads();

    const int here = min(WORLDS_A_TILE, worlds - at_tile.world) * TOKENS;
    for (int i = threadIdx.x; i < here * HALF_CHUNKS; i += THREADS) {
      const int row = i / HALF_CHUNKS, chunk = i % HALF_CHUNKS;
      float total[8] = {};
      add_to(total, *(const uint4*)(tile + at<CHUNKS>(row, piece + chunk)));
#pragma unroll
      for (int k = 0; k < JOINTS + THRUSTERS; ++k) {
        const int message = Numbers::of(row / TOKENS, k);
        if (from_of(ends[message]) == row) add_to(total, *(const uint4*)(told + at<HALF_CHUNKS>(message, chunk)));
      }
      out[((long long)at_tile.world * TOKENS + row) * CHUNKS + piece + chunk] = packed(total);
    }
  }
}

// Of x and of the terms.
extern "C" __global__ void __launch_bounds__(THREADS, 2)
    messages_gradient(const int* num_worlds, const uint4* grad, const u32* joints, const u32* thrusters,
                      const uint4* weights, uint4* grad_x, uint4* grad_joint_terms, uint4* grad_thruster_terms) {
  SHARED_MEMORY(MessagesGradientShared, own);
  const int piece = (blockIdx.x & 1) * HALF_CHUNKS, worlds = *num_worlds;
  for (int i = threadIdx.x; i < 3 * HALF * CHUNKS; i += THREADS) {
    const int row = i / CHUNKS, kind = row / HALF;
    *(uint4*)(own.weights + at<CHUNKS>(row, i % CHUNKS)) =
        weights[(kind * WIDTH + piece * 8 + row % HALF) * CHUNKS + i % CHUNKS];
  }

  const auto begin = [&](int stage, int world) {
    begin_rows<CHUNKS, X_ROWS>(own.tiles[stage], grad, (long long)world * TOKENS,
                               min(WORLDS_A_TILE, worlds - world) * TOKENS, 0);
    end_group();
  };
  Tiles at_tile;
  begin(0, at_tile.world);
  u32 next = load_ends(joints, thrusters, at_tile.world, worlds);
  for (; at_tile.world < worlds; at_tile.advance()) {
    const char* tile = own.tiles[at_tile.stage()];
    u32* ends = own.ends[at_tile.stage()];
    if (threadIdx.x < MESSAGES) ends[threadIdx.x] = next;
    wait_for_copies<0>();
    __syncthreads();  // with the tile before every thread is done
    begin(at_tile.stage() ^ 1, at_tile.world + at_tile.stride);
    next = load_ends(joints, thrusters, at_tile.world + at_tile.stride, worlds);

    // Sixteen rows and sixteen numbers of them at a time: of x_from, of x_to, of x_owner.
    constexpr int GROUPS = HALF / 16;
    for (int unit = warp(); unit < (MESSAGES + JOINT_ROWS) / 16 * GROUPS; unit += WARPS) {
      const int m = unit / GROUPS * 16, n = unit % GROUPS * 16;
      const int kind = m < JOINT_ROWS ? 0 : m < 2 * JOINT_ROWS ? 1 : 2;
      const int message = kind == 0 ? m : m - JOINT_ROWS;  // of the first row
      const u32 from_a = of_a<CHUNKS>(tile, from_of(ends[message + lane_row()]));
      const u32 from_b = of_b<CHUNKS>(own.weights, kind * HALF + n + lane_row_t());
      Sums<1, 2> sums;
      sums.clear();
      sums.add<WIDTH>([&](u32 (&words)[4], int, int k) { ldmatrix(words, from_a ^ 2 * k); },
                      [&](u32 (&words)[4], int k, int) { ldmatrix(words, from_b ^ 2 * k); });
      sums.each_pair(0, n, [&](float one, float two, int row, int column) {
        *pair_at<HALF_CHUNKS>(own.of_rows, m + row, column) = exists(ends[message + row]) ? pack(one, two) : 0u;
      });
    }
    __syncthreads();

    const int here = min(WORLDS_A_TILE, worlds - at_tile.world);
    for (int i = threadIdx.x; i < here * TOKENS * HALF_CHUNKS; i += THREADS) {
      const int row = i / HALF_CHUNKS, chunk = i % HALF_CHUNKS;
      float total[8] = {};
      add_to(total, *(const uint4*)(tile + at<CHUNKS>(row, piece + chunk)));
#pragma unroll
      for (int k = 0; k < JOINTS + THRUSTERS; ++k) {
        const int message = Numbers::of(row / TOKENS, k);
        const int first = k < JOINTS ? message : JOINT_ROWS + message, second = JOINT_ROWS + message;
        if (from_of(ends[message]) == row)
          add_to(total, *(const uint4*)(own.of_rows + at<HALF_CHUNKS>(first, chunk)));
        if (k < JOINTS && to_of(ends[message]) == row)
          add_to(total, *(const uint4*)(own.of_rows + at<HALF_CHUNKS>(second, chunk)));
      }
      grad_x[((long long)at_tile.world * TOKENS + row) * CHUNKS + piece + chunk] = packed(total);
    }
    for (int i = threadIdx.x; i < here * (JOINTS + THRUSTERS) * HALF_CHUNKS; i += THREADS) {
      const int number = i / HALF_CHUNKS, chunk = i % HALF_CHUNKS;
      const bool is_joint = number < here * JOINTS;
      const int own_number = is_joint ? number : number - here * JOINTS;
      const u32 end = ends[is_joint ? own_number : JOINT_ROWS + own_number];
      const uint4 given = *(const uint4*)(tile + at<CHUNKS>(from_of(end), piece + chunk));
      uint4* to = is_joint ? grad_joint_terms + (long long)at_tile.world * JOINTS * CHUNKS
                           : grad_thruster_terms + (long long)at_tile.world * THRUSTERS * CHUNKS;
      to[own_number * CHUNKS + piece + chunk] = exists(end) ? given : make_uint4(0, 0, 0, 0);
    }
  }
}

// Of the weights: [pairs of blocks, 384, 128] float32, of each pair.
extern "C" __global__ void __launch_bounds__(THREADS, 2)
    messages_weight_gradient(const int* num_worlds, const uint4* x, const uint4* grad, const u32* joints,
                             const u32* thrusters, float* grad_weights) {
  SHARED_MEMORY(MessagesWeightGradientShared, own);
  const int piece = (blockIdx.x & 1) * HALF_CHUNKS, worlds = *num_worlds, m = warp() * 16;
  if (threadIdx.x < HALF_CHUNKS) *(uint4*)(own.zeros + threadIdx.x * 16) = make_uint4(0, 0, 0, 0);

  const auto begin = [&](int stage, int world) {
    const long long first = (long long)world * TOKENS;
    const int here = min(WORLDS_A_TILE, worlds - world) * TOKENS;
    begin_rows<CHUNKS, X_ROWS>(own.tiles[stage], x, first, here, 0);
    begin_rows<HALF_CHUNKS, X_ROWS>(own.grads[stage], grad, first, here, piece);
    end_group();
  };
  Sums<1, 8> of_from, of_to, of_owner;
  of_from.clear();
  of_to.clear();
  of_owner.clear();
  Tiles at_tile;
  begin(0, at_tile.world);
  u32 next = load_ends(joints, thrusters, at_tile.world, worlds);
  for (; at_tile.world < worlds; at_tile.advance()) {
    const char *tile = own.tiles[at_tile.stage()], *of_out = own.grads[at_tile.stage()];
    u32* ends = own.ends[at_tile.stage()];
    if (threadIdx.x < MESSAGES) ends[threadIdx.x] = next;
    wait_for_copies<0>();
    __syncthreads();  // with the tile before every thread is done
    begin(at_tile.stage() ^ 1, at_tile.world + at_tile.stride);
    next = load_ends(joints, thrusters, at_tile.world + at_tile.stride, worlds);

    for (int k = 0; k < MESSAGES; k += 16) {
      const u32 of_rows = ends[k + lane_row_t()], of_grad = ends[k + lane_row()];
      // What does not exist has a row of zeros for its gradient.
      const u32 from_b = exists(of_grad) ? of_b_t<HALF_CHUNKS>(of_out, from_of(of_grad))
                                         : shared_address(own.zeros) + (lane() >> 4) * 16;
      const bool is_joint = k < JOINT_ROWS;
      u32 at_from[4], at_to[4], b[4];
      ldmatrix_trans(at_from, of_a_t<CHUNKS>(tile, from_of(of_rows)) ^ 2 * m);
      if (is_joint) ldmatrix_trans(at_to, of_a_t<CHUNKS>(tile, to_of(of_rows)) ^ 2 * m);
#pragma unroll
      for (int t = 0; t < 8; t += 2) {
        ldmatrix_trans(b, from_b ^ 16 * t);
        if (is_joint) {
          mma(of_from.of[0][t], at_from, b[0], b[1]);
          mma(of_from.of[0][t + 1], at_from, b[2], b[3]);
          mma(of_to.of[0][t], at_to, b[0], b[1]);
          mma(of_to.of[0][t + 1], at_to, b[2], b[3]);
        } else {
          mma(of_owner.of[0][t], at_from, b[0], b[1]);
          mma(of_owner.of[0][t + 1], at_from, b[2], b[3]);
        }
      }
    }
  }
  float* to = grad_weights + (long long)(blockIdx.x >> 1) * 3 * WIDTH * WIDTH + piece * 8;
  of_from.store(to, m, 0, WIDTH);
  of_to.store(to + WIDTH * WIDTH, m, 0, WIDTH);
  of_owner.store(to + 2 * WIDTH * WIDTH, m, 0, WIDTH);
}
