// What exists in a world as tokens: for each of one or two groups of rows of features
//
//     token = tanh(features W + b)
//
// in float32, rounded at the end; and the gradient of W and b. Groups lie one after another among the TOKENS of a world;
// what comes behind them (the dummy token) is ones. Features are [worlds, ROWS_0, FEATURES_0] and [worlds, ROWS_1,
// FEATURES_1] float32; ROWS_1 is 0 where there is one group. A kernel is [features + 1, 128] with b as its last row,
// filled up with zeros to a multiple of 4 rows (DEPTH): features get a 1 and zeros behind them. tokens and slopes, the
// derivatives of tanh, are [worlds, TOKENS, 128] in bfloat16. Each block adds up its own part of the gradient.

#include "tile.cuh"

#if !defined(TOKENS) || !defined(ROWS_0) || !defined(FEATURES_0) || !defined(ROWS_1) || !defined(FEATURES_1)
#error "TOKENS of a world, and ROWS and FEATURES of both groups"
#endif

constexpr int DEPTH_0 = FEATURES_0 / 4 * 4 + 4, DEPTH_1 = FEATURES_1 / 4 * 4 + 4;
constexpr int ROWS_A_WARP = 8, COLUMNS_A_LANE = WIDTH / 32;
static_assert(ROWS_0 + ROWS_1 <= TOKENS, "tokens of both groups");

// The rows of so many worlds: those of the first group come first, whole eights of either.
template <int WORLDS>
struct Tile {
  static_assert(WORLDS % ROWS_A_WARP == 0, "rows are whole eights");
  static constexpr int OF_0 = WORLDS * ROWS_0, OF_1 = WORLDS * ROWS_1, ALL = OF_0 + OF_1;
  float features[OF_0 * DEPTH_0 + OF_1 * DEPTH_1];

  __device__ __forceinline__ const float* of_row_0(int row) const { return features + row * DEPTH_0; }
  __device__ __forceinline__ const float* of_row_1(int row) const { return features + OF_0 * DEPTH_0 + row * DEPTH_1; }

  // The token of a row, counted from the first world of the tile.
  static __device__ __forceinline__ int token_of(int row) {
    const int other = row - OF_0;
    if (ROWS_1 == 0 || other < 0) return row / ROWS_0 * TOKENS + row % ROWS_0;
    return other / max(ROWS_1, 1) * TOKENS + ROWS_0 + other % max(ROWS_1, 1);
  }

  __device__ __forceinline__ void load(const float* features_0, const float* features_1, int world, int here);
};

constexpr int ENCODED_WORLDS = 32;   // so many rows that eight warps have about as many each
constexpr int GRADIENT_WORLDS = 8;   // whose gradients are in shared memory

struct EncodeShared {
  float weights[(DEPTH_0 + DEPTH_1) * WIDTH];
  Tile<ENCODED_WORLDS> tile;
};

struct EncodeGradientShared {
  Tile<GRADIENT_WORLDS> tile;
  float grads[Tile<GRADIENT_WORLDS>::ALL * WIDTH];  // of the sums before tanh
};

SHARED_BYTES(encode, EncodeShared)
SHARED_BYTES(encode_and_keep, EncodeShared)
SHARED_BYTES(encode_gradient, EncodeGradientShared)

__device__ __forceinline__ float4 load4(const float* from) { return *(const float4*)from; }

// Rows of the features of a tile, each with a 1 behind it; zeros where there is no world.
template <int NUM_ROWS, int FEATURES, int DEPTH>
__device__ __forceinline__ void load_features(float* to, const float* from, int num_rows) {
  for (int i = threadIdx.x; i < NUM_ROWS * DEPTH; i += THREADS) {
    const int row = i / DEPTH, feature = i % DEPTH;
    to[i] = row >= num_rows || feature > FEATURES ? 0.0f : feature == FEATURES ? 1.0f : from[row * FEATURES + feature];
  }
}

template <int WORLDS>
__device__ __forceinline__ void Tile<WORLDS>::load(const float* features_0, const float* features_1, int world,
                                                   int here) {
  load_features<OF_0, FEATURES_0, DEPTH_0>(features, features_0 + (long long)world * ROWS_0 * FEATURES_0, here * ROWS_0);
  if (ROWS_1 > 0)
    load_features<OF_1, FEATURES_1, DEPTH_1>(features + OF_0 * DEPTH_0,
                                             features_1 + (long long)world * ROWS_1 * FEATURES_1, here * ROWS_1);
}

// Eight rows of a group: a lane has four columns of each.
template <int DEPTH>
__device__ __forceinline__ void encode_rows(const float* features, const float* weights, float (&sums)[8][4]) {
#pragma unroll
  for (int r = 0; r < ROWS_A_WARP; ++r)
#pragma unroll
    for (int c = 0; c < COLUMNS_A_LANE; ++c) sums[r][c] = 0.0f;
#pragma unroll 1
  for (int f = 0; f < DEPTH; f += 4) {
    float4 of_row[4];
#pragma unroll
    for (int i = 0; i < 4; ++i) of_row[i] = load4(weights + (f + i) * WIDTH + lane() * COLUMNS_A_LANE);
#pragma unroll
    for (int r = 0; r < ROWS_A_WARP; ++r) {
      const float4 own = load4(features + r * DEPTH + f);
      const float numbers[4] = {own.x, own.y, own.z, own.w};
#pragma unroll
      for (int i = 0; i < 4; ++i) {
        sums[r][0] += numbers[i] * of_row[i].x;
        sums[r][1] += numbers[i] * of_row[i].y;
        sums[r][2] += numbers[i] * of_row[i].z;
        sums[r][3] += numbers[i] * of_row[i].w;
      }
    }
  }
}

// slopes: null where there is to be no gradient.
__device__ __forceinline__ void encode_tiles(int worlds, const float* features_0, const float* features_1,
                                             const float* kernel_0, const float* kernel_1, uint2* tokens,
                                             uint2* slopes) {
  SHARED_MEMORY(EncodeShared, own);
  for (int i = threadIdx.x; i < DEPTH_0 * WIDTH; i += THREADS) own.weights[i] = kernel_0[i];
  if (ROWS_1 > 0)
    for (int i = threadIdx.x; i < DEPTH_1 * WIDTH; i += THREADS) own.weights[DEPTH_0 * WIDTH + i] = kernel_1[i];

  typedef Tile<ENCODED_WORLDS> Rows;
  for (int world = blockIdx.x * ENCODED_WORLDS; world < worlds; world += gridDim.x * ENCODED_WORLDS) {
    const int here = min(ENCODED_WORLDS, worlds - world);
    own.tile.load(features_0, features_1, world, here);
    __syncthreads();
    for (int first = warp() * ROWS_A_WARP; first < Rows::ALL; first += WARPS * ROWS_A_WARP) {
      float sums[ROWS_A_WARP][COLUMNS_A_LANE];
      if (first < Rows::OF_0)
        encode_rows<DEPTH_0>(own.tile.of_row_0(first), own.weights, sums);
      else
        encode_rows<DEPTH_1>(own.tile.of_row_1(first - Rows::OF_0), own.weights + DEPTH_0 * WIDTH, sums);
#pragma unroll
      for (int r = 0; r < ROWS_A_WARP; ++r) {
        const int token = Rows::token_of(first + r);
        if (token / TOKENS >= here) continue;
        const long long place = ((long long)world * TOKENS + token) * 32 + lane();
        float y[COLUMNS_A_LANE], slope[COLUMNS_A_LANE];
#pragma unroll
        for (int c = 0; c < COLUMNS_A_LANE; ++c) {  // tanh s = 1 - 2 u and its derivative 4 u (1 - u), u = 1 / (1 + e^2s)
          const float u = reciprocal(1.0f + power_of_2(sums[r][c] * (2.0f * 1.44269504f)));
          y[c] = 1.0f - 2.0f * u;
          slope[c] = 4.0f * u * (1.0f - u);
        }
        tokens[place] = make_uint2(pack(y[0], y[1]), pack(y[2], y[3]));
        if (slopes != nullptr) slopes[place] = make_uint2(pack(slope[0], slope[1]), pack(slope[2], slope[3]));
      }
    }
    constexpr int OTHERS = TOKENS - ROWS_0 - ROWS_1;
    if (OTHERS > 0)
      for (int i = threadIdx.x; i < here * OTHERS * 32; i += THREADS) {
        const int number = i / 32, of_world = number / max(OTHERS, 1);
        const int token = of_world * TOKENS + ROWS_0 + ROWS_1 + number % max(OTHERS, 1);
        const long long place = ((long long)world * TOKENS + token) * 32 + i % 32;
        tokens[place] = make_uint2(pack(1.0f, 1.0f), pack(1.0f, 1.0f));
        if (slopes != nullptr) slopes[place] = make_uint2(0u, 0u);
      }
    __syncthreads();
  }
}

extern "C" __global__ void __launch_bounds__(THREADS, 3)
    encode(const int* num_worlds, const float* features_0, const float* features_1, const float* kernel_0,
           const float* kernel_1, uint2* tokens) {
  encode_tiles(*num_worlds, features_0, features_1, kernel_0, kernel_1, tokens, nullptr);
}

extern "C" __global__ void __launch_bounds__(THREADS, 3)
    encode_and_keep(const int* num_worlds, const float* features_0, const float* features_1, const float* kernel_0,
                    const float* kernel_1, uint2* tokens, uint2* slopes) {
  encode_tiles(*num_worlds, features_0, features_1, kernel_0, kernel_1, tokens, slopes);
}

// The part of a warp of the gradient of a kernel: as many rows of it as there are warps for, and four columns a lane.
template <int DEPTH>
struct OwnRows {
  static constexpr int COUNT = (DEPTH / 4 + WARPS - 1) / WARPS * 4;
  float sums[COUNT][COLUMNS_A_LANE];

  __device__ __forceinline__ void clear() {
#pragma unroll
    for (int f = 0; f < COUNT; ++f)
#pragma unroll
      for (int c = 0; c < COLUMNS_A_LANE; ++c) sums[f][c] = 0.0f;
  }

  __device__ __forceinline__ void add(const float* features, const float* grads, int num_rows) {
#pragma unroll 4
    for (int row = 0; row < num_rows; ++row) {
      const float4 grad = load4(grads + row * WIDTH + lane() * COLUMNS_A_LANE);
#pragma unroll
      for (int i = 0; i < COUNT; i += 4) {
        const int f = warp() * COUNT + i;
        if (f >= DEPTH) break;
        const float4 own = load4(features + row * DEPTH + f);
        const float numbers[4] = {own.x, own.y, own.z, own.w};
#pragma unroll
        for (int j = 0; j < 4; ++j) {
          sums[i + j][0] += numbers[j] * grad.x;
          sums[i + j][1] += numbers[j] * grad.y;
          sums[i + j][2] += numbers[j] * grad.z;
          sums[i + j][3] += numbers[j] * grad.w;
        }
      }
    }
  }

  __device__ __forceinline__ void store(float* to) {
#pragma unroll
    for (int i = 0; i < COUNT; ++i) {
      const int f = warp() * COUNT + i;
      if (f < DEPTH)
        *(float4*)(to + f * WIDTH + lane() * COLUMNS_A_LANE) =
            make_float4(sums[i][0], sums[i][1], sums[i][2], sums[i][3]);
    }
  }
};

// grad_0, grad_1: [blocks, DEPTH, 128].
extern "C" __global__ void __launch_bounds__(THREADS, 3)
    encode_gradient(const int* num_worlds, const float* features_0, const float* features_1, const uint2* grad_tokens,
                    const uint2* slopes, float* grad_0, float* grad_1) {
  SHARED_MEMORY(EncodeGradientShared, own);
  const int worlds = *num_worlds;
  OwnRows<DEPTH_0> of_0;
  OwnRows<DEPTH_1> of_1;
  of_0.clear();
  of_1.clear();
  typedef Tile<GRADIENT_WORLDS> Rows;
  for (int world = blockIdx.x * GRADIENT_WORLDS; world < worlds; world += gridDim.x * GRADIENT_WORLDS) {
    const int here = min(GRADIENT_WORLDS, worlds - world);
    own.tile.load(features_0, features_1, world, here);
    for (int i = threadIdx.x; i < Rows::ALL * 32; i += THREADS) {
      const int token = Rows::token_of(i / 32);
      float4 grad = make_float4(0.0f, 0.0f, 0.0f, 0.0f);
      if (token / TOKENS < here) {
        const long long place = ((long long)world * TOKENS + token) * 32 + i % 32;
        const uint2 of_token = grad_tokens[place], slope = slopes[place];
        grad = make_float4(low(of_token.x) * low(slope.x), high(of_token.x) * high(slope.x),
                           low(of_token.y) * low(slope.y), high(of_token.y) * high(slope.y));
      }
      *(float4*)(own.grads + i * COLUMNS_A_LANE) = grad;
    }
    __syncthreads();
    of_0.add(own.tile.of_row_0(0), own.grads, Rows::OF_0);
    if (ROWS_1 > 0) of_1.add(own.tile.of_row_1(0), own.grads + Rows::OF_0 * WIDTH, Rows::OF_1);
    __syncthreads();
  }
  of_0.store(grad_0 + (long long)blockIdx.x * DEPTH_0 * WIDTH);
  of_1.store(grad_1 + (long long)blockIdx.x * DEPTH_1 * WIDTH);
}
