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
// of its own row. A row is given what belongs to it by the bits of a word, one a message of its world.

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

static_assert(JOINTS + THRUSTERS <= 32, "the messages of a world are bits of a word");

struct MessagesShared {
  char weights[3 * WIDTH * HALF_CHUNKS * 16];  // the own columns
  char tile[X_ROWS * CHUNKS * 16];
  char told[MESSAGES * HALF_CHUNKS * 16];  // terms, then messages
  u32 ends[MESSAGES], given[X_ROWS];       // to each row
};

struct MessagesGradientShared {
  char weights[3 * HALF * CHUNKS * 16];  // rows: the own half of the numbers of x_from, x_to, x_owner
  char tile[X_ROWS * CHUNKS * 16];
  char of_rows[(MESSAGES + JOINT_ROWS) * HALF_CHUNKS * 16];  // gradients of x_from, x_to, x_owner
  u32 ends[MESSAGES], as_first[X_ROWS], as_second[X_ROWS];   // messages of which a row is x_from or x_owner, x_to
};

struct MessagesWeightGradientShared {
  char tile[X_ROWS * CHUNKS * 16];
  char grad[X_ROWS * HALF_CHUNKS * 16];  // the own columns
  char zeros[HALF_CHUNKS * 16];
  u32 ends[MESSAGES];
};

SHARED_BYTES(messages, MessagesShared)
SHARED_BYTES(messages_gradient, MessagesGradientShared)
SHARED_BYTES(messages_weight_gradient, MessagesWeightGradientShared)

// The ends of a message: rows of the tile, and whether it exists.
__device__ __forceinline__ int from_of(u32 ends) { return ends & 0xfff; }
__device__ __forceinline__ int to_of(u32 ends) { return ends >> 12 & 0xfff; }
__device__ __forceinline__ bool exists(u32 ends) { return ends >> 24 & 1; }

// The message of a joint or thruster, k of its world.
__device__ __forceinline__ int message_of(int world, int k) {
  return k < JOINTS ? world * JOINTS + k : JOINT_ROWS + world * THRUSTERS + k - JOINTS;
}

// The ends of the message that this thread has, and which of its world it is.
struct Own {
  u32 ends, bit;
};

__device__ __forceinline__ Own load_own(const u32* joints, const u32* thrusters, int world, int worlds) {
  const bool is_joint = threadIdx.x < JOINT_ROWS;
  const int number = is_joint ? threadIdx.x : threadIdx.x - JOINT_ROWS, each = is_joint ? JOINTS : THRUSTERS;
  const int of_world = number / each;
  if (of_world >= WORLDS_A_TILE || world + of_world >= worlds) return {0u, 0u};
  const u32 word = (is_joint ? joints : thrusters)[(long long)world * each + number];
  const u32 first = of_world * TOKENS, doing = word >> 16 & 1;
  return {(first + (word & 255)) | (first + (word >> 8 & 255)) << 12 | doing << 24,
          doing << (number - of_world * each + (is_joint ? 0 : JOINTS))};
}

// Begins to copy rows, the first `num_rows` of which are there, into a tile with rows of ROW_CHUNKS pieces.
template <int ROW_CHUNKS, int NUM_ROWS>
__device__ __forceinline__ void begin_rows(char* tile, const uint4* rows, int num_rows) {
  constexpr int STEP = THREADS / ROW_CHUNKS;  // rows, a multiple of 8
  const int row = threadIdx.x / ROW_CHUNKS, chunk = threadIdx.x % ROW_CHUNKS;
  char* to = tile + at<ROW_CHUNKS>(row, chunk);
  const uint4* from = rows + row * CHUNKS + chunk;
#pragma unroll
  for (int i = 0; i < NUM_ROWS; i += STEP)
    if (i + STEP <= NUM_ROWS || row < NUM_ROWS - i)
      copy_async(to + i * ROW_CHUNKS * 16, from + i * CHUNKS, row < num_rows - i);
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

// `visit(row, piece)` for rows of the tile, a piece of eight columns of the own half at a time.
template <typename Visit>
__device__ __forceinline__ void each_piece(int num_rows, Visit visit) {
  for (int row = threadIdx.x / HALF_CHUNKS; row < num_rows; row += THREADS / HALF_CHUNKS)
    visit(row, threadIdx.x % HALF_CHUNKS);
}

// Adds the pieces of the messages whose bits are set, in their order. number_of(message): its row.
template <typename NumberOf>
__device__ __forceinline__ void add_bits(float (&total)[8], u32 bits, int world, const char* rows, int chunk,
                                         NumberOf number_of) {
  for (; bits; bits &= bits - 1) {
    const int row = number_of(message_of(world, __ffs(bits) - 1));
    add_to(total, *(const uint4*)(rows + at<HALF_CHUNKS>(row, chunk)));
  }
}

extern "C" __global__ void __launch_bounds__(THREADS, 2)
    messages(const int* num_worlds, const uint4* x, const u32* joints, const u32* thrusters, const uint4* joint_terms,
             const uint4* thruster_terms, const uint4* weights, uint4* out) {
  SHARED_MEMORY(MessagesShared, own);
  const int piece = (blockIdx.x & 1) * HALF_CHUNKS, worlds = *num_worlds;
  for (int i = threadIdx.x; i < 3 * WIDTH * HALF_CHUNKS; i += THREADS)
    *(uint4*)(own.weights + at<HALF_CHUNKS>(i / HALF_CHUNKS, i % HALF_CHUNKS)) =
        weights[i / HALF_CHUNKS * CHUNKS + piece + i % HALF_CHUNKS];

  const int stride = (gridDim.x >> 1) * WORLDS_A_TILE;
  for (int world = (blockIdx.x >> 1) * WORLDS_A_TILE; world < worlds; world += stride) {
    const int here = min(WORLDS_A_TILE, worlds - world);
    const long long first = (long long)world * TOKENS;
    begin_rows<CHUNKS, X_ROWS>(own.tile, x + first * CHUNKS, here * TOKENS);
    begin_rows<HALF_CHUNKS, JOINT_ROWS>(own.told, joint_terms + (long long)world * JOINTS * CHUNKS + piece, here * JOINTS);
    begin_rows<HALF_CHUNKS, THRUSTER_ROWS>(own.told + JOINT_ROWS * HALF_CHUNKS * 16,
                                           thruster_terms + (long long)world * THRUSTERS * CHUNKS + piece,
                                           here * THRUSTERS);
    end_group();
    const Own message = load_own(joints, thrusters, world, worlds);
    if (threadIdx.x < MESSAGES) own.ends[threadIdx.x] = message.ends;
    if (threadIdx.x < X_ROWS) own.given[threadIdx.x] = 0u;
    wait_for_copies<0>();
    __syncthreads();
    if (message.bit) atomicOr(&own.given[from_of(message.ends)], message.bit);

    // Sixteen messages and half of the own columns at a time.
    for (int unit = warp(); unit < MESSAGES / 16 * 2; unit += WARPS) {
      const int m = unit / 2 * 16, n = unit % 2 * (HALF / 2);
      const bool is_joint = m < JOINT_ROWS;
      const u32 end = own.ends[m + lane_row()];
      Sums<1, 4> sums;
      sums.clear();
      for (int part = 0; part < (is_joint ? 2 : 1); ++part) {
        const u32 from_a = of_a<CHUNKS>(own.tile, part == 0 ? from_of(end) : to_of(end));
        const u32 from_b =
            of_b_t<HALF_CHUNKS>(own.weights + (is_joint ? part : 2) * WIDTH * HALF_CHUNKS * 16, lane_row()) ^ 2 * n;
        sums.add<WIDTH>([&](u32 (&words)[4], int, int k) { ldmatrix(words, from_a ^ 2 * k); },
                        [&](u32 (&words)[4], int k, int t) {
                          ldmatrix_trans(words, (from_b + k * HALF_CHUNKS * 16) ^ 16 * t);
                        });
      }
      sums.each_pair(m, n, [&](float one, float two, int row, int column) {
        u32* term = pair_at<HALF_CHUNKS>(own.told, row, column);
        *term = pack(one + low(*term), two + high(*term));
      });
    }
    __syncthreads();

    each_piece(here * TOKENS, [&](int row, int chunk) {
      float total[8] = {};
      add_to(total, *(const uint4*)(own.tile + at<CHUNKS>(row, piece + chunk)));
      add_bits(total, own.given[row], row / TOKENS, own.told, chunk, [](int number) { return number; });
      out[(first + row) * CHUNKS + piece + chunk] = packed(total);
    });
    __syncthreads();
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

  const int stride = (gridDim.x >> 1) * WORLDS_A_TILE;
  for (int world = (blockIdx.x >> 1) * WORLDS_A_TILE; world < worlds; world += stride) {
    const int here = min(WORLDS_A_TILE, worlds - world);
    const long long first = (long long)world * TOKENS;
    begin_rows<CHUNKS, X_ROWS>(own.tile, grad + first * CHUNKS, here * TOKENS);
    end_group();
    const Own message = load_own(joints, thrusters, world, worlds);
    if (threadIdx.x < MESSAGES) own.ends[threadIdx.x] = message.ends;
    if (threadIdx.x < X_ROWS) own.as_first[threadIdx.x] = own.as_second[threadIdx.x] = 0u;
    wait_for_copies<0>();
    __syncthreads();
    if (message.bit) {
      atomicOr(&own.as_first[from_of(message.ends)], message.bit);
      if (threadIdx.x < JOINT_ROWS) atomicOr(&own.as_second[to_of(message.ends)], message.bit);
    }

    // Sixteen rows and half of the own numbers at a time: of x_from, of x_to, of x_owner.
    for (int unit = warp(); unit < (MESSAGES + JOINT_ROWS) / 16 * 2; unit += WARPS) {
      const int m = unit / 2 * 16, n = unit % 2 * (HALF / 2);
      const int kind = m < JOINT_ROWS ? 0 : m < 2 * JOINT_ROWS ? 1 : 2;
      const int number = kind == 0 ? m : m - JOINT_ROWS;  // of the first message
      const u32 from_a = of_a<CHUNKS>(own.tile, from_of(own.ends[number + lane_row()]));
      const u32 from_b = of_b<CHUNKS>(own.weights, kind * HALF + n + lane_row_t());
      Sums<1, 4> sums;
      sums.clear();
      sums.add<WIDTH>([&](u32 (&words)[4], int, int k) { ldmatrix(words, from_a ^ 2 * k); },
                      [&](u32 (&words)[4], int k, int t) { ldmatrix(words, (from_b + t * CHUNKS * 128) ^ 2 * k); });
      sums.each_pair(m, n, [&](float one, float two, int row, int column) {
        *pair_at<HALF_CHUNKS>(own.of_rows, row, column) = pack(one, two);
      });
    }
    __syncthreads();

    each_piece(here * TOKENS, [&](int row, int chunk) {
      float total[8] = {};
      add_to(total, *(const uint4*)(own.tile + at<CHUNKS>(row, piece + chunk)));
      add_bits(total, own.as_first[row], row / TOKENS, own.of_rows, chunk,
               [](int number) { return number < JOINT_ROWS ? number : number + JOINT_ROWS; });
      add_bits(total, own.as_second[row], row / TOKENS, own.of_rows, chunk,
               [](int number) { return number + JOINT_ROWS; });
      grad_x[(first + row) * CHUNKS + piece + chunk] = packed(total);
    });
    const auto give_terms = [&](uint4* terms, int each, int first_message) {
      each_piece(here * each, [&](int number, int chunk) {
        const u32 end = own.ends[first_message + number];
        const uint4 given = *(const uint4*)(own.tile + at<CHUNKS>(from_of(end), piece + chunk));
        terms[((long long)world * each + number) * CHUNKS + piece + chunk] = exists(end) ? given : make_uint4(0, 0, 0, 0);
      });
    };
    give_terms(grad_joint_terms, JOINTS, 0);
    give_terms(grad_thruster_terms, THRUSTERS, JOINT_ROWS);
    __syncthreads();
  }
}

// Of the weights: [pairs of blocks, 384, 128] float32, of each pair.
extern "C" __global__ void __launch_bounds__(THREADS, 2)
    messages_weight_gradient(const int* num_worlds, const uint4* x, const uint4* grad, const u32* joints,
                             const u32* thrusters, float* grad_weights) {
  SHARED_MEMORY(MessagesWeightGradientShared, own);
  const int piece = (blockIdx.x & 1) * HALF_CHUNKS, worlds = *num_worlds, m = warp() * 16;
  if (threadIdx.x < HALF_CHUNKS) *(uint4*)(own.zeros + threadIdx.x * 16) = make_uint4(0, 0, 0, 0);

  Sums<1, 8> of_from, of_to, of_owner;
  of_from.clear();
  of_to.clear();
  of_owner.clear();
  const int stride = (gridDim.x >> 1) * WORLDS_A_TILE;
  for (int world = (blockIdx.x >> 1) * WORLDS_A_TILE; world < worlds; world += stride) {
    const int here = min(WORLDS_A_TILE, worlds - world);
    const long long first = (long long)world * TOKENS;
    begin_rows<CHUNKS, X_ROWS>(own.tile, x + first * CHUNKS, here * TOKENS);
    begin_rows<HALF_CHUNKS, X_ROWS>(own.grad, grad + first * CHUNKS + piece, here * TOKENS);
    end_group();
    const Own message = load_own(joints, thrusters, world, worlds);
    if (threadIdx.x < MESSAGES) own.ends[threadIdx.x] = message.ends;
    wait_for_copies<0>();
    __syncthreads();

    for (int k = 0; k < MESSAGES; k += 16) {
      const u32 of_rows = own.ends[k + lane_row_t()], of_grad = own.ends[k + lane_row()];
      // What does not exist has a row of zeros for its gradient.
      const u32 from_b = exists(of_grad) ? of_b_t<HALF_CHUNKS>(own.grad, from_of(of_grad))
                                         : shared_address(own.zeros) + (lane() >> 4) * 16;
      const bool is_joint = k < JOINT_ROWS;
      u32 at_from[4], at_to[4], b[4];
      ldmatrix_trans(at_from, of_a_t<CHUNKS>(own.tile, from_of(of_rows)) ^ 2 * m);
      if (is_joint) ldmatrix_trans(at_to, of_a_t<CHUNKS>(own.tile, to_of(of_rows)) ^ 2 * m);
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
    __syncthreads();
  }
  float* to = grad_weights + (long long)(blockIdx.x >> 1) * 3 * WIDTH * WIDTH + piece * 8;
  of_from.store(to, m, 0, WIDTH);
  of_to.store(to + WIDTH * WIDTH, m, 0, WIDTH);
  of_owner.store(to + 2 * WIDTH * WIDTH, m, 0, WIDTH);
}
