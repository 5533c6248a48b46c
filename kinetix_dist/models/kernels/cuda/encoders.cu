// What exists in a world as tokens: for each of one or two groups of rows of features
//
//     token = tanh(features W + b)
//
// rounded at the end; and the gradient of W and b. Groups lie one after another among the TOKENS of a world; what comes
// behind them (the dummy token) is ones. Features are [worlds, ROWS_0, FEATURES_0] and [worlds, ROWS_1, FEATURES_1]
// float32; ROWS_1 is 0 where there is one group. W is [features, 128], b [128], float32. tokens and slopes, the
// derivatives of tanh, are [worlds, TOKENS, 128] in bfloat16.
//
// Products have nearly the precision of float32: a number is what bfloat16 holds of it (high) and what that leaves
// (low), and high x high + low x high + high x low lacks 2^-16 of it. What bfloat16 holds as infinite becomes NaN.
// Features get a 1 behind them, W gets b as its last row, both are filled up with zeros to DEPTH. A tile is 64 rows of
// a group, of whichever worlds they are.

#include "tile.cuh"

#if !defined(TOKENS) || !defined(ROWS_0) || !defined(FEATURES_0) || !defined(ROWS_1) || !defined(FEATURES_1)
#error "TOKENS of a world, and ROWS and FEATURES of both groups"
#endif

template <int NUM_ROWS_, int FEATURES_, int FIRST_, int DEPTH_BEFORE_>
struct Group {
  static constexpr int NUM_ROWS = NUM_ROWS_, FEATURES = FEATURES_;
  static constexpr int FIRST = FIRST_;                // of its tokens among those of a world
  static constexpr int DEPTH_BEFORE = DEPTH_BEFORE_;  // rows of the kernels of groups before
  static constexpr int DEPTH = NUM_ROWS > 0 ? FEATURES / 32 * 32 + 32 : 0;
  static constexpr int A_CHUNKS = DEPTH / 4;  // of a row of a tile of features: high, then low

  static __device__ __forceinline__ int num_tiles(int worlds) { return (worlds * NUM_ROWS + ROWS - 1) / ROWS; }

  static __device__ __forceinline__ long long token_of(int row) {
    return (long long)(row / NUM_ROWS) * TOKENS + FIRST + row % NUM_ROWS;
  }
};

typedef Group<ROWS_0, FEATURES_0, 0, 0> First;
typedef Group<ROWS_1, FEATURES_1, ROWS_0, First::DEPTH> Second;
constexpr int MAX_DEPTH = First::DEPTH > Second::DEPTH ? First::DEPTH : Second::DEPTH;
constexpr int KERNEL_BYTES = (First::DEPTH + Second::DEPTH) * WIDTH * 2;
static_assert(First::NUM_ROWS + Second::NUM_ROWS <= TOKENS, "tokens of both groups");

template <int OUTPUTS>
struct EncodeShared {
  char kernel_high[KERNEL_BYTES], kernel_low[KERNEL_BYTES];
  char features[ROWS * MAX_DEPTH * 4];
  char out[OUTPUTS][TILE_BYTES];  // tokens; slopes
};

struct EncodeGradientShared {
  char features[ROWS * MAX_DEPTH * 4];
  char grad_high[TILE_BYTES], grad_low[TILE_BYTES];  // of the sums before tanh
};

SHARED_BYTES(encode, EncodeShared<1>)
SHARED_BYTES(encode_and_keep, EncodeShared<2>)
SHARED_BYTES(encode_gradient, EncodeGradientShared)

struct Split {
  u32 high, low;
};

__device__ __forceinline__ Split split(float first, float second) {
  const u32 of_both = pack(first, second);
  return {of_both, pack(first - low(of_both), second - high(of_both))};
}

// A thread's part of a tile of features, on its way from memory.
template <typename G>
struct Features {
  static constexpr int PAIRS_A_ROW = G::DEPTH / 2, COUNT = ROWS * PAIRS_A_ROW / THREADS;
  float of[COUNT][2];

  static __device__ __forceinline__ int row(int i) { return (threadIdx.x + i * THREADS) / PAIRS_A_ROW; }
  static __device__ __forceinline__ int column(int i) { return (threadIdx.x + i * THREADS) % PAIRS_A_ROW * 2; }

  // The rows from `first` on, of `num_rows`: zeros where there is none.
  __device__ __forceinline__ void load(const float* features, int first, int num_rows) {
    features += (long long)first * G::FEATURES;
#pragma unroll
    for (int i = 0; i < COUNT; ++i)
#pragma unroll
      for (int j = 0; j < 2; ++j) {
        const int feature = column(i) + j;
        of[i][j] = feature == G::FEATURES ? 1.0f : 0.0f;
        if (first + row(i) >= num_rows)
          of[i][j] = 0.0f;
        else if (feature < G::FEATURES)
          of[i][j] = features[row(i) * G::FEATURES + feature];
      }
  }

  __device__ __forceinline__ void store(char* tile) const {
#pragma unroll
    for (int i = 0; i < COUNT; ++i) {
      const Split both = split(of[i][0], of[i][1]);
      *pair_at<G::A_CHUNKS>(tile, row(i), column(i)) = both.high;
      *pair_at<G::A_CHUNKS>(tile, row(i), G::DEPTH + column(i)) = both.low;
    }
  }
};

// The first tile of a block: those of the second group go on where those of the first end.
__device__ __forceinline__ int first_tile(int tiles_before) {
  return (blockIdx.x + gridDim.x - tiles_before % gridDim.x) % gridDim.x;
}

template <typename G>
__device__ __forceinline__ void load_kernel(char* to_high, char* to_low, const float* kernel, const float* bias) {
  for (int i = threadIdx.x; i < G::DEPTH * WIDTH / 2; i += THREADS) {
    const int row = i / (WIDTH / 2), column = i % (WIDTH / 2) * 2;
    const float* from = row < G::FEATURES ? kernel + row * WIDTH : bias;
    const bool is_there = row <= G::FEATURES;
    const Split both = split(is_there ? from[column] : 0.0f, is_there ? from[column + 1] : 0.0f);
    *pair_at<CHUNKS>(to_high, row, column) = both.high;
    *pair_at<CHUNKS>(to_low, row, column) = both.low;
  }
}

template <typename G, int OUTPUTS>
__device__ __forceinline__ void encode_group(EncodeShared<OUTPUTS>& own, int worlds, int tiles_before,
                                             const float* features, const float* kernel, const float* bias,
                                             uint4* tokens, uint4* slopes) {
  constexpr int DEPTH = G::DEPTH;
  char* kernel_high = own.kernel_high + G::DEPTH_BEFORE * WIDTH * 2;
  char* kernel_low = own.kernel_low + G::DEPTH_BEFORE * WIDTH * 2;
  load_kernel<G>(kernel_high, kernel_low, kernel, bias);
  const int num_rows = worlds * G::NUM_ROWS, tiles = G::num_tiles(worlds);
  Features<G> next;
  int tile = first_tile(tiles_before);
  if (tile < tiles) next.load(features, tile * ROWS, num_rows);
  for (; tile < tiles; tile += gridDim.x) {
    next.store(own.features);
    __syncthreads();
    if (tile + gridDim.x < tiles) next.load(features, (tile + gridDim.x) * ROWS, num_rows);
    PartSums sums;
    sums.clear();
    const u32 from_a = of_a<G::A_CHUNKS>(own.features, part_row() + lane_row());
    const u32 from_b = of_b_t<CHUNKS>(kernel_high, lane_row()) ^ 2 * part_column();
    sums.template add<2 * DEPTH>(
        [&](u32(&words)[4], int s, int k) { ldmatrix(words, (from_a + s * G::A_CHUNKS * 256) ^ 2 * k); },
        [&](u32(&words)[4], int k, int t) { ldmatrix_trans(words, (from_b + k % DEPTH * CHUNKS * 16) ^ 16 * t); });
    sums.template add_product<DEPTH, G::A_CHUNKS, CHUNKS>(own.features, part_row(), kernel_low, part_column());
    sums.each_pair(part_row(), part_column(), [&](float first, float second, int row, int column) {
      // tanh s = 1 - 2 u and its derivative 4 u (1 - u), u = 1 / (1 + e^2s)
      const float u = reciprocal(1.0f + power_of_2(first * (2.0f * 1.44269504f)));
      const float v = reciprocal(1.0f + power_of_2(second * (2.0f * 1.44269504f)));
      *pair_at<CHUNKS>(own.out[0], row, column) = pack(1.0f - 2.0f * u, 1.0f - 2.0f * v);
      if (OUTPUTS > 1)
        *pair_at<CHUNKS>(own.out[OUTPUTS - 1], row, column) = pack(4.0f * u * (1.0f - u), 4.0f * v * (1.0f - v));
    });
    __syncthreads();
    const int row = tile * ROWS + quarter_row();
    if (row < num_rows) {
      const long long place = G::token_of(row) * CHUNKS;
      const Quarter of_token = copied_quarter(own.out[0]), of_slope = copied_quarter(own.out[OUTPUTS - 1]);
#pragma unroll
      for (int i = 0; i < 4; ++i) {
        tokens[place + quarter_chunk(i)] = of_token.pieces[i];
        if (OUTPUTS > 1) slopes[place + quarter_chunk(i)] = of_slope.pieces[i];
      }
    }
  }
}

template <int OUTPUTS>
__device__ __forceinline__ void encode_all(const int* num_worlds, const float* features_0, const float* features_1,
                                           const float* kernel_0, const float* kernel_1, const float* bias_0,
                                           const float* bias_1, uint4* tokens, uint4* slopes) {
  SHARED_MEMORY(EncodeShared<OUTPUTS>, own);
  const int worlds = *num_worlds;
  encode_group<First>(own, worlds, 0, features_0, kernel_0, bias_0, tokens, slopes);
  if constexpr (Second::NUM_ROWS > 0)
    encode_group<Second>(own, worlds, First::num_tiles(worlds), features_1, kernel_1, bias_1, tokens, slopes);
  constexpr int GROUPS = First::NUM_ROWS + Second::NUM_ROWS, OTHERS = TOKENS - GROUPS;
  if constexpr (OTHERS > 0) {
    constexpr u32 ONES = 0x3f803f80u;
    const long long end = (long long)worlds * OTHERS * CHUNKS;
    for (long long i = blockIdx.x * THREADS + threadIdx.x; i < end; i += gridDim.x * THREADS) {
      const long long other = i / CHUNKS, token = other / OTHERS * TOKENS + GROUPS + other % OTHERS;
      tokens[token * CHUNKS + i % CHUNKS] = make_uint4(ONES, ONES, ONES, ONES);
      if (OUTPUTS > 1) slopes[token * CHUNKS + i % CHUNKS] = make_uint4(0, 0, 0, 0);
    }
  }
}

extern "C" __global__ void __launch_bounds__(THREADS, 3)
    encode(const int* num_worlds, const float* features_0, const float* features_1, const float* kernel_0,
           const float* kernel_1, const float* bias_0, const float* bias_1, uint4* tokens) {
  encode_all<1>(num_worlds, features_0, features_1, kernel_0, kernel_1, bias_0, bias_1, tokens, nullptr);
}

extern "C" __global__ void __launch_bounds__(THREADS, 2)
    encode_and_keep(const int* num_worlds, const float* features_0, const float* features_1, const float* kernel_0,
                    const float* kernel_1, const float* bias_0, const float* bias_1, uint4* tokens, uint4* slopes) {
  encode_all<2>(num_worlds, features_0, features_1, kernel_0, kernel_1, bias_0, bias_1, tokens, slopes);
}

// The part of a block of the gradient of W, with that of b behind it.
template <typename G>
__device__ __forceinline__ void gradient_of_group(EncodeGradientShared& own, int worlds, int tiles_before,
                                                  const float* features, const uint4* grad_tokens, const uint4* slopes,
                                                  float* grad) {
  const int num_rows = worlds * G::NUM_ROWS, tiles = G::num_tiles(worlds);
  const int columns = 16 * warp();
  Sums<G::DEPTH / 16, 2> sums;
  sums.clear();
  for (int tile = first_tile(tiles_before); tile < tiles; tile += gridDim.x) {
    Features<G> of_rows;
    of_rows.load(features, tile * ROWS, num_rows);
    const int row = tile * ROWS + quarter_row();
    const bool is_there = row < num_rows;
    const long long place = is_there ? G::token_of(row) * CHUNKS : 0;
    Quarter of_token, slope;
#pragma unroll
    for (int i = 0; i < 4; ++i) {
      of_token.pieces[i] = is_there ? grad_tokens[place + quarter_chunk(i)] : make_uint4(0, 0, 0, 0);
      slope.pieces[i] = is_there ? slopes[place + quarter_chunk(i)] : make_uint4(0, 0, 0, 0);
    }
    of_rows.store(own.features);
#pragma unroll
    for (int i = 0; i < 4; ++i) {
      const u32 of_pairs[4] = {of_token.pieces[i].x, of_token.pieces[i].y, of_token.pieces[i].z, of_token.pieces[i].w};
      const u32 slopes_of[4] = {slope.pieces[i].x, slope.pieces[i].y, slope.pieces[i].z, slope.pieces[i].w};
      Split both[4];
#pragma unroll
      for (int j = 0; j < 4; ++j)
        both[j] = split(low(of_pairs[j]) * low(slopes_of[j]), high(of_pairs[j]) * high(slopes_of[j]));
      const int to = at<CHUNKS>(quarter_row(), quarter_chunk(i));
      *(uint4*)(own.grad_high + to) = make_uint4(both[0].high, both[1].high, both[2].high, both[3].high);
      *(uint4*)(own.grad_low + to) = make_uint4(both[0].low, both[1].low, both[2].low, both[3].low);
    }
    __syncthreads();
    sums.template add_outer<ROWS, G::A_CHUNKS, CHUNKS>(own.features, 0, own.grad_high, columns);
    sums.template add_outer<ROWS, G::A_CHUNKS, CHUNKS>(own.features, G::DEPTH, own.grad_high, columns);
    sums.template add_outer<ROWS, G::A_CHUNKS, CHUNKS>(own.features, 0, own.grad_low, columns);
    __syncthreads();
  }
  sums.store(grad + (long long)blockIdx.x * G::DEPTH * WIDTH, 0, columns, WIDTH);
}

// grad_0, grad_1: [blocks, DEPTH, 128] float32; one number where there is no such group.
extern "C" __global__ void __launch_bounds__(THREADS, 3)
    encode_gradient(const int* num_worlds, const float* features_0, const float* features_1, const uint4* grad_tokens,
                    const uint4* slopes, float* grad_0, float* grad_1) {
  SHARED_MEMORY(EncodeGradientShared, own);
  const int worlds = *num_worlds;
  gradient_of_group<First>(own, worlds, 0, features_0, grad_tokens, slopes, grad_0);
  if constexpr (Second::NUM_ROWS > 0)
    gradient_of_group<Second>(own, worlds, First::num_tiles(worlds), features_1, grad_tokens, slopes, grad_1);
  else if (blockIdx.x == 0 && threadIdx.x == 0)
    grad_1[0] = 0.0f;
}
