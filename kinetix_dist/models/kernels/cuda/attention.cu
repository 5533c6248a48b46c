// The attention part of a layer, between a stream x and the gate that lets y into it:
//
//     q, k, v = normalise(x) W + b           weight_ij = mask_ij exp(q_i . k_j / sqrt(D)) / sum over j
//     y = relu(o W_out + b_out)              o_i = sum over j of weight_ij v_j         for each of the heads
//
// and its gradient: of y's and of the stream's own gradient those of x and of the four parameters. Nothing but x is
// kept for it; what the backward pass needs is computed again. Heads are two numbers wide: scores and sums are
// multiply-adds of single threads, the products around them run on tensor cores. A tile holds whole worlds: as many of
// TOKENS rows each as fit in 64 rows.
//
// x, y and their gradients are [worlds, TOKENS, 128] in bfloat16; W [128, 64] (norm folded in; 16 columns each of
// queries, keys and values, 16 of zeros) and W_out [16, 128] in bfloat16, b [64] and b_out [128] float32. mask_words:
// [4, worlds, TOKENS], bit j of a word: the token may look at token j of its world; head h has mask h / 2. A token that
// may look at none gets 0. Sums are float32. Each block adds up its own part of the gradients of parameters.

#include "tile.cuh"

#ifndef TOKENS
#error "TOKENS of a world"
#endif

constexpr int HEADS = 8, MASKS = 4, FEATURES = 16;  // of all heads, two each
constexpr int QKV = 3 * FEATURES, QKV_CHUNKS = 8;   // columns, and pieces of a row of 64 with the zeros
constexpr int OUT_CHUNKS = FEATURES / 8;
constexpr int WORLDS_A_TILE = ROWS / TOKENS, ROWS_A_TILE = WORLDS_A_TILE * TOKENS;
constexpr int HEADS_A_THREAD = ROWS * HEADS / THREADS;
constexpr float SCALE = 0.70710678f;         // 1 / sqrt(D)
constexpr float SCORE = SCALE * 1.44269504f;  // for powers of 2
constexpr float UNSEEN = -1e30f;              // a score
static_assert(TOKENS <= 32, "a mask row is one word");

struct AttentionShared {
  char weights[WIDTH * QKV_CHUNKS * 16];
  char out_weights[FEATURES * CHUNKS * 16];
  char tiles[2][TILE_BYTES];  // in turns, so that one is written while the other is still stored
  char out[ROWS * OUT_CHUNKS * 16];  // what the heads give
  float qkv[ROWS * QKV];
};

struct AttentionGradientShared {
  char weights[WIDTH * QKV_CHUNKS * 16];
  char out_weights[FEATURES * CHUNKS * 16];
  char normal[TILE_BYTES];
  char grad[TILE_BYTES];    // of y
  char stream[TILE_BYTES];  // the gradient of the stream, then of x
  char out[ROWS * OUT_CHUNKS * 16];
  char of_qkv[ROWS * QKV_CHUNKS * 16];  // gradients
  float qkv[ROWS * QKV];
  float of_out[ROWS * FEATURES];  // gradients
  float2 sums[ROWS * HEADS];      // of a head: logarithm of the sum of its exponentials; output times its gradient
  u32 seen[ROWS * MASKS];
  NormGradient norm;
};

SHARED_BYTES(attention, AttentionShared)
SHARED_BYTES(attention_gradient, AttentionGradientShared)

__device__ __forceinline__ float2 pair_of(const float* rows, int row, int column, int columns) {
  return *(const float2*)(rows + row * columns + column);
}

__device__ __forceinline__ float dot(float2 a, float2 b) { return a.x * b.x + a.y * b.y; }

__device__ __forceinline__ void add(float2& sum, float factor, float2 b) {
  sum.x += factor * b.x;
  sum.y += factor * b.y;
}

// Which head of which row a thread has, the i-th of its own.
__device__ __forceinline__ int head_row(int i) { return (threadIdx.x + i * THREADS) / HEADS; }
__device__ __forceinline__ int head_number() { return threadIdx.x % HEADS; }

// Whom the row of a head may look at; nobody where there is no row.
__device__ __forceinline__ u32 load_seen(int i, const u32* mask_words, int worlds, int world) {
  const int row = head_row(i);
  if (row >= ROWS_A_TILE || world + row / TOKENS >= worlds) return 0u;
  return mask_words[((long long)(head_number() >> 1) * worlds + world) * TOKENS + row];
}

// Queries, keys and values of a tile of normalised rows. qkv: [64, 48] float32.
__device__ __forceinline__ void project(const char* normal, const char* weights, const float* bias, float* qkv) {
  const int m = part_row(), n = (warp() >> 1) * 16;
  if (n >= QKV) return;
  Sums<2, 2> sums;
  sums.clear();
  sums.add_product<WIDTH, CHUNKS, QKV_CHUNKS>(normal, m, weights, n);
  sums.each_pair(m, n, [&](float one, float two, int row, int column) {
    *(float2*)(qkv + row * QKV + column) = make_float2(one + bias[column], two + bias[column + 1]);
  });
}

// What a head gives, and the logarithm (to 2) of the sum of its exponentials.
__device__ __forceinline__ float2 attend(int row, u32 seen, const float* qkv, float* log_sum) {
  const int first = row / TOKENS * TOKENS, column = head_number() * 2;
  const float2 query = pair_of(qkv, row, column, QKV);
  float scores[TOKENS], highest = UNSEEN;
#pragma unroll
  for (int j = 0; j < TOKENS; ++j) {
    const float score = SCORE * dot(query, pair_of(qkv, first + j, FEATURES + column, QKV));
    scores[j] = seen >> j & 1 ? score : UNSEEN;
    highest = fmaxf(highest, scores[j]);
  }
  if (seen == 0) highest = 0.0f;
  float2 out = make_float2(0.0f, 0.0f);
  float total = seen == 0 ? 1.0f : 0.0f;
#pragma unroll
  for (int j = 0; j < TOKENS; ++j) {
    const float weight = power_of_2(scores[j] - highest);
    total += weight;
    add(out, weight, pair_of(qkv, first + j, 2 * FEATURES + column, QKV));
  }
  *log_sum = highest + logarithm_to_2(total);
  return make_float2(out.x / total, out.y / total);
}

// The sum before relu at W_out: a warp's part.
__device__ __forceinline__ void project_out(PartSums& sums, const char* out, const char* weights) {
  sums.clear();
  sums.add_product<FEATURES, OUT_CHUNKS, CHUNKS>(out, part_row(), weights, part_column());
}

extern "C" __global__ void __launch_bounds__(THREADS, 3)
    attention(const int* num_worlds, const uint4* x, const u32* mask_words, const uint4* kernel, const float* bias,
              const uint4* out_kernel, const float* out_bias, uint4* y) {
  SHARED_MEMORY(AttentionShared, own);
  const int worlds = *num_worlds, stride = gridDim.x * WORLDS_A_TILE;
  load_weights<QKV_CHUNKS>(own.weights, kernel, WIDTH * QKV_CHUNKS);
  load_weights<CHUNKS>(own.out_weights, out_kernel, FEATURES * CHUNKS);

  int world = blockIdx.x * WORLDS_A_TILE;
  Quarter next = load_quarter(x, (long long)world * TOKENS, min(WORLDS_A_TILE, worlds - world) * TOKENS);
  for (int number = 0; world < worlds; world += stride, ++number) {
    const long long first = (long long)world * TOKENS;
    char* tile = own.tiles[number & 1];
    normalise(next, tile);
    __syncthreads();
    next = load_quarter(x, first + (long long)stride * TOKENS, min(WORLDS_A_TILE, worlds - world - stride) * TOKENS);
    u32 seen[HEADS_A_THREAD];
#pragma unroll
    for (int i = 0; i < HEADS_A_THREAD; ++i) seen[i] = load_seen(i, mask_words, worlds, world);
    project(tile, own.weights, bias, own.qkv);
    __syncthreads();
#pragma unroll
    for (int i = 0; i < HEADS_A_THREAD; ++i) {
      float log_sum;
      const float2 given = attend(min(head_row(i), ROWS_A_TILE - 1), seen[i], own.qkv, &log_sum);
      *pair_at<OUT_CHUNKS>(own.out, head_row(i), head_number() * 2) = pack(given.x, given.y);
    }
    __syncthreads();
    PartSums sums;
    project_out(sums, own.out, own.out_weights);
    sums.each_pair(part_row(), part_column(), [&](float one, float two, int row, int column) {
      *pair_at<CHUNKS>(tile, row, column) =
          pack(relu(one + out_bias[column]), relu(two + out_bias[column + 1]));
    });
    __syncthreads();
    store_rows(tile, y, first, min(WORLDS_A_TILE, worlds - world) * TOKENS);
  }
}

// Gradients of parameters are of each block: grad_kernel [blocks, 128, 64], grad_bias [blocks, 64], grad_out_kernel
// [blocks, 16, 128], grad_out_bias [blocks, 128].
extern "C" __global__ void __launch_bounds__(THREADS, 2)
    attention_gradient(const int* num_worlds, const uint4* x, const uint4* grad_stream, const uint4* grad_y,
                       const u32* mask_words, const uint4* kernel, const float* bias, const uint4* out_kernel,
                       const float* out_bias, uint4* grad_x, float* grad_kernel, float* grad_bias,
                       float* grad_out_kernel, float* grad_out_bias) {
  SHARED_MEMORY(AttentionGradientShared, own);
  const int m = part_row(), n = part_column(), worlds = *num_worlds, stride = gridDim.x * WORLDS_A_TILE;
  load_weights<QKV_CHUNKS>(own.weights, kernel, WIDTH * QKV_CHUNKS);
  load_weights<CHUNKS>(own.out_weights, out_kernel, FEATURES * CHUNKS);

  // Of this warp: 32 rows and 32 columns of the gradient of W, 16 columns of the others (of b the first four warps).
  Sums<2, 4> of_kernel;
  Sums<1, 2> of_out_kernel;
  ColumnSums of_bias, of_out_bias;
  const int kernel_row = (warp() >> 1) * 32, kernel_column = (warp() & 1) * 32;
  of_kernel.clear();
  of_out_kernel.clear();
  of_bias.sums.clear();
  of_out_bias.sums.clear();
  int world = blockIdx.x * WORLDS_A_TILE;
  Quarter next = load_quarter(x, (long long)world * TOKENS, min(WORLDS_A_TILE, worlds - world) * TOKENS);
  begin_copy(own.grad, grad_y, (long long)world * TOKENS, min(WORLDS_A_TILE, worlds - world) * TOKENS);
  end_group();
  for (; world < worlds; world += stride) {
    const int here = min(WORLDS_A_TILE, worlds - world) * TOKENS;
    const int then = min(WORLDS_A_TILE, worlds - world - stride) * TOKENS;
    const long long first = (long long)world * TOKENS, first_then = first + (long long)stride * TOKENS;
    u32 seen[HEADS_A_THREAD];
#pragma unroll
    for (int i = 0; i < HEADS_A_THREAD; ++i) seen[i] = load_seen(i, mask_words, worlds, world);
    const float inverse_std = normalise(next, own.normal);
    if ((threadIdx.x & 3) == 0) own.norm.inverse_std[quarter_row()] = inverse_std;
    wait_for_copies<0>();
    __syncthreads();  // of the tile before, everything is stored
    begin_copy(own.stream, grad_stream, first, here);
    end_group();
    next = load_quarter(x, first_then, then);
    project(own.normal, own.weights, bias, own.qkv);
    __syncthreads();
#pragma unroll
    for (int i = 0; i < HEADS_A_THREAD; ++i) {
      const int row = head_row(i), head = head_number();
      float log_sum;
      const float2 given = attend(min(row, ROWS_A_TILE - 1), seen[i], own.qkv, &log_sum);
      *pair_at<OUT_CHUNKS>(own.out, row, head * 2) = pack(given.x, given.y);
      own.sums[row * HEADS + head].x = log_sum;
      if (head % 2 == 0) own.seen[row * MASKS + head / 2] = seen[i];
    }
    __syncthreads();

    {  // Of y, what reaches the sum before relu.
      PartSums sums;
      project_out(sums, own.out, own.out_weights);
      sums.each_pair(m, n, [&](float one, float two, int row, int column) {
        *pair_at<CHUNKS>(own.grad, row, column) &= kept_by_relu(one + out_bias[column], two + out_bias[column + 1]);
      });
    }
    __syncthreads();
    of_out_kernel.add_outer<ROWS, OUT_CHUNKS, CHUNKS>(own.out, 0, own.grad, warp() * 16);
    of_out_bias.add<ROWS, CHUNKS>(own.grad, warp() * 16);
    if (warp() < 4) {  // of what the heads gave: four warps have 16 rows each
      Sums<1, 2> sums;
      sums.clear();
      sums.add_transposed<WIDTH, CHUNKS, CHUNKS>(own.grad, warp() * 16, own.out_weights, 0);
      sums.each_pair(warp() * 16, 0, [&](float one, float two, int row, int column) {
        *(float2*)(own.of_out + row * FEATURES + column) = make_float2(one, two);
        const u32 given = *pair_at<OUT_CHUNKS>(own.out, row, column);
        own.sums[row * HEADS + column / 2].y = one * low(given) + two * high(given);
      });
    }
    __syncthreads();
    begin_copy(own.grad, grad_y, first_then, then);  // which no warp reads any more
    end_group();
#pragma unroll
    for (int i = 0; i < HEADS_A_THREAD; ++i) {
      const int row = head_row(i), head = head_number(), column = head * 2;
      const int in_tile = min(row, ROWS_A_TILE - 1), first_row = in_tile / TOKENS * TOKENS, token = in_tile - first_row;
      float2 of_query = make_float2(0.0f, 0.0f), of_key = of_query, of_value = of_query;
      const float2 query = pair_of(own.qkv, in_tile, column, QKV);
      const float2 key = pair_of(own.qkv, in_tile, FEATURES + column, QKV);
      const float2 value = pair_of(own.qkv, in_tile, 2 * FEATURES + column, QKV);
      const float2 of_own = pair_of(own.of_out, in_tile, column, FEATURES), sums = own.sums[in_tile * HEADS + head];
#pragma unroll 5
      for (int t = 0; t < TOKENS; ++t) {
        const int other = first_row + t;
        const float2 other_query = pair_of(own.qkv, other, column, QKV);
        const float2 other_key = pair_of(own.qkv, other, FEATURES + column, QKV);
        const float2 other_value = pair_of(own.qkv, other, 2 * FEATURES + column, QKV);
        const float2 of_other = pair_of(own.of_out, other, column, FEATURES);
        const float2 other_sums = own.sums[other * HEADS + head];
        // What this token sees of the other.
        const float score = SCORE * dot(query, other_key) - sums.x;
        const float weight = power_of_2(seen[i] >> t & 1 ? score : UNSEEN);
        add(of_query, weight * (dot(of_own, other_value) - sums.y), other_key);
        // What the other sees of this one.
        const float other_score = SCORE * dot(other_query, key) - other_sums.x;
        const float other_weight = power_of_2(own.seen[other * MASKS + head / 2] >> token & 1 ? other_score : UNSEEN);
        add(of_key, other_weight * (dot(of_other, value) - other_sums.y), other_query);
        add(of_value, other_weight, of_other);
      }
      if (row >= ROWS_A_TILE) of_query = of_key = of_value = make_float2(0.0f, 0.0f);
      *pair_at<QKV_CHUNKS>(own.of_qkv, row, column) = pack(of_query.x * SCALE, of_query.y * SCALE);
      *pair_at<QKV_CHUNKS>(own.of_qkv, row, FEATURES + column) = pack(of_key.x * SCALE, of_key.y * SCALE);
      *pair_at<QKV_CHUNKS>(own.of_qkv, row, 2 * FEATURES + column) = pack(of_value.x, of_value.y);
      *pair_at<QKV_CHUNKS>(own.of_qkv, row, 3 * FEATURES + column) = 0u;
    }
    __syncthreads();
    of_kernel.add_outer<ROWS, CHUNKS, QKV_CHUNKS>(own.normal, kernel_row, own.of_qkv, kernel_column);
    if (warp() < 4) of_bias.add<ROWS, QKV_CHUNKS>(own.of_qkv, warp() * 16);
    PartSums of_normal;
    of_normal.clear();
    of_normal.add_transposed<QKV, QKV_CHUNKS, QKV_CHUNKS>(own.of_qkv, m, own.weights, n);
    own.norm.begin(of_normal, own.normal);
    wait_for_copies<1>();  // the stream is there; the next gradient may be under way
    __syncthreads();
    own.norm.finish(of_normal, own.normal, own.stream);
    __syncthreads();
    store_rows(own.stream, grad_x, first, here);
  }
  const long long block = blockIdx.x;
  of_kernel.store(grad_kernel + block * WIDTH * 64, kernel_row, kernel_column, 64);
  of_out_kernel.store(grad_out_kernel + block * FEATURES * WIDTH, 0, warp() * 16, WIDTH);
  of_out_bias.store(grad_out_bias + block * WIDTH, warp() * 16);
  if (warp() < 4) of_bias.store(grad_bias + block * 64, warp() * 16);
}
