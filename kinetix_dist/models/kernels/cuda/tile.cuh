// What the kernels of this folder share: tiles of rows in shared memory, products of them on tensor cores, norms.
//
// A block has 256 threads and works on tiles of rows of 128 numbers in bfloat16. A tile in shared memory is rows of
// CHUNKS pieces of 16 bytes. A piece is stored in the place of its number with the last three bits of the row's number
// flipped, so that the eight rows that `ldmatrix` reads at once lie in different banks.
//
// Products are mma.sync.m16n8k16: bfloat16 in, float32 sums. In the product C[m][n] = sum over k of A[m][k] B[k][n] a
// thread (lane l of its warp) holds of 16 x 8 numbers of C those in row l / 4, columns 2 (l % 4) and the next, and
// those in row l / 4 + 8. Operands lie in shared memory either way round.

#pragma once

#ifdef ON_CPU
#include "cuda_on_cpu.h"
#else

typedef unsigned int u32;

extern __shared__ __align__(256) char shared_memory[];
#define SHARED_MEMORY(type, name) type& name = *(type*)shared_memory

__device__ __forceinline__ u32 shared_address(const char* place) { return (u32)__cvta_generic_to_shared(place); }

__device__ __forceinline__ void ldmatrix(u32 (&r)[4], u32 address) {
  asm volatile("ldmatrix.sync.aligned.m8n8.x4.shared.b16 {%0,%1,%2,%3}, [%4];"
               : "=r"(r[0]), "=r"(r[1]), "=r"(r[2]), "=r"(r[3]) : "r"(address) : "memory");
}

__device__ __forceinline__ void ldmatrix_trans(u32 (&r)[4], u32 address) {
  asm volatile("ldmatrix.sync.aligned.m8n8.x4.trans.shared.b16 {%0,%1,%2,%3}, [%4];"
               : "=r"(r[0]), "=r"(r[1]), "=r"(r[2]), "=r"(r[3]) : "r"(address) : "memory");
}

__device__ __forceinline__ void mma(float (&c)[4], const u32 (&a)[4], u32 b0, u32 b1) {
  asm volatile("mma.sync.aligned.m16n8k16.row.col.f32.bf16.bf16.f32 {%0,%1,%2,%3}, {%4,%5,%6,%7}, {%8,%9}, {%0,%1,%2,%3};"
               : "+f"(c[0]), "+f"(c[1]), "+f"(c[2]), "+f"(c[3])
               : "r"(a[0]), "r"(a[1]), "r"(a[2]), "r"(a[3]), "r"(b0), "r"(b1));
}

// Two numbers in bfloat16, rounded to nearest even; `low` in the lower half.
__device__ __forceinline__ u32 pack(float low, float high) {
  u32 packed;
  asm("cvt.rn.bf16x2.f32 %0, %1, %2;" : "=r"(packed) : "f"(high), "f"(low));
  return packed;
}

__device__ __forceinline__ float power_of_2(float x) {
  float y;
  asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
  return y;
}

__device__ __forceinline__ float logarithm_to_2(float x) {
  float y;
  asm("lg2.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
  return y;
}

__device__ __forceinline__ float reciprocal(float x) {
  float y;
  asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
  return y;
}

__device__ __forceinline__ float from_lane(float x, int flipped) { return __shfl_xor_sync(0xffffffffu, x, flipped); }

// 16 bytes from memory to shared memory, without a register; zeros where not `is_there`.
__device__ __forceinline__ void copy_async(char* to, const uint4* from, bool is_there) {
  const u32 address = shared_address(to);
  asm volatile("cp.async.cg.shared.global [%0], [%1], 16, %2;" : : "r"(address), "l"(from), "r"(is_there ? 16 : 0) : "memory");
}

// What was begun since the last call is a group; waits until at most N groups of this thread are under way.
__device__ __forceinline__ void end_group() { asm volatile("cp.async.commit_group;" : : : "memory"); }
template <int N>
__device__ __forceinline__ void wait_for_copies() { asm volatile("cp.async.wait_group %0;" : : "n"(N) : "memory"); }

#endif

// How much shared memory a kernel takes, for who launches it: read from the PTX.
#define SHARED_BYTES(kernel, type)                     \
  extern "C" {                                         \
  __device__ int kernel##_shared_bytes = sizeof(type); \
  }

constexpr int WIDTH = 128;  // of a token
constexpr int CHUNKS = 16;  // of a token: pieces of 8 numbers, 16 bytes
constexpr int THREADS = 256, WARPS = THREADS / 32;
constexpr int ROWS = 64;  // of a tile, unless a kernel says otherwise
constexpr int TILE_BYTES = ROWS * WIDTH * 2;
constexpr float NORM_EPSILON = 1e-6f;

__device__ __forceinline__ float low(u32 packed) { return __uint_as_float(packed << 16); }
__device__ __forceinline__ float high(u32 packed) { return __uint_as_float(packed & 0xffff0000u); }

// NaN stays NaN, which fmaxf would drop.
__device__ __forceinline__ float relu(float x) { return x <= 0.0f ? 0.0f : x; }

__device__ __forceinline__ int lane() { return threadIdx.x & 31; }
__device__ __forceinline__ int warp() { return threadIdx.x >> 5; }

// Where a piece of a row lies, in bytes.
template <int ROW_CHUNKS>
__device__ __forceinline__ int at(int row, int chunk) {
  static_assert(ROW_CHUNKS == 2 || ROW_CHUNKS % 8 == 0, "rows of 32 bytes or of a multiple of 128");
  const int flipped = ROW_CHUNKS == 2 ? (row >> 2) & 1 : row & 7;
  return (row * ROW_CHUNKS + (chunk ^ flipped)) * 16;
}

// The two numbers of a row from an even column on.
template <int ROW_CHUNKS>
__device__ __forceinline__ u32* pair_at(char* tile, int row, int column) {
  return (u32*)(tile + at<ROW_CHUNKS>(row, column >> 3) + (column & 7) * 2);
}

// Operands: the address from which this lane reads, of a tile at 256 bytes. It is of the first piece of a row; whatever
// is 2 x columns (a multiple of 16) further is at that address ^ 2 x columns, so that a loop needs one address only.
//
//     stored [m][k]   ldmatrix          of_a(tile, m + lane_row()) ^ 2 k
//     stored [k][m]   ldmatrix_trans    of_a_t(tile, k + lane_row_t()) ^ 2 m
//     stored [n][k]   ldmatrix          of_b(tile, n + lane_row_t()) ^ 2 k
//     stored [k][n]   ldmatrix_trans    of_b_t(tile, k + lane_row()) ^ 2 n
//
// One read is 16 x 16 numbers: of B words 0 and 1 are of eight columns, 2 and 3 of the next eight.
__device__ __forceinline__ int lane_row() { return lane() & 15; }
__device__ __forceinline__ int lane_row_t() { return (lane() & 7) + (lane() >> 4) * 8; }

template <int ROW_CHUNKS>
__device__ __forceinline__ u32 of_a(const char* tile, int row) {
  return shared_address(tile) + at<ROW_CHUNKS>(row, lane() >> 4);
}
template <int ROW_CHUNKS>
__device__ __forceinline__ u32 of_a_t(const char* tile, int row) {
  return shared_address(tile) + at<ROW_CHUNKS>(row, lane() >> 3 & 1);
}
template <int ROW_CHUNKS>
__device__ __forceinline__ u32 of_b(const char* tile, int row) {
  return of_a_t<ROW_CHUNKS>(tile, row);
}
template <int ROW_CHUNKS>
__device__ __forceinline__ u32 of_b_t(const char* tile, int row) {
  return of_a<ROW_CHUNKS>(tile, row);
}

// Sums of a warp: 16 M rows and 8 N columns, N even.
template <int M, int N>
struct Sums {
  float of[M][N][4];

  __device__ __forceinline__ void clear() {
#pragma unroll
    for (int s = 0; s < M; ++s)
#pragma unroll
      for (int t = 0; t < N; ++t)
#pragma unroll
        for (int i = 0; i < 4; ++i) of[s][t][i] = 0.0f;
  }

  // += A[16 M][K] B[K][8 N]. The words of A for (s, k), of B for (k, t and t + 1).
  template <int K, typename ReadA, typename ReadB>
  __device__ __forceinline__ void add(ReadA read_a, ReadB read_b) {
    static_assert(N % 2 == 0, "columns come in sixteens");
#pragma unroll
    for (int k = 0; k < K; k += 16) {
      u32 a[M][4], b[4];
#pragma unroll
      for (int s = 0; s < M; ++s) read_a(a[s], s, k);
#pragma unroll
      for (int t = 0; t < N; t += 2) {
        read_b(b, k, t);
#pragma unroll
        for (int s = 0; s < M; ++s) {
          mma(of[s][t], a[s], b[0], b[1]);
          mma(of[s][t + 1], a[s], b[2], b[3]);
        }
      }
    }
  }

  // A stored [m][k], B stored [k][n].
  template <int K, int A_CHUNKS, int B_CHUNKS>
  __device__ __forceinline__ void add_product(const char* a, int m, const char* b, int n) {
    const u32 from_a = of_a<A_CHUNKS>(a, m + lane_row()), from_b = of_b_t<B_CHUNKS>(b, lane_row()) ^ 2 * n;
    add<K>([&](u32 (&words)[4], int s, int k) { ldmatrix(words, (from_a + s * A_CHUNKS * 256) ^ 2 * k); },
           [&](u32 (&words)[4], int k, int t) { ldmatrix_trans(words, (from_b + k * B_CHUNKS * 16) ^ 16 * t); });
  }

  // A stored [m][k], B stored [n][k]: a product with the transpose of what is stored.
  template <int K, int A_CHUNKS, int B_CHUNKS>
  __device__ __forceinline__ void add_transposed(const char* a, int m, const char* b, int n) {
    const u32 from_a = of_a<A_CHUNKS>(a, m + lane_row()), from_b = of_b<B_CHUNKS>(b, n + lane_row_t());
    add<K>([&](u32 (&words)[4], int s, int k) { ldmatrix(words, (from_a + s * A_CHUNKS * 256) ^ 2 * k); },
           [&](u32 (&words)[4], int k, int t) { ldmatrix(words, (from_b + t * B_CHUNKS * 128) ^ 2 * k); });
  }

  // A stored [k][m], B stored [k][n]: what a gradient of a kernel is made of.
  template <int K, int A_CHUNKS, int B_CHUNKS>
  __device__ __forceinline__ void add_outer(const char* a, int m, const char* b, int n) {
    const u32 from_a = of_a_t<A_CHUNKS>(a, lane_row_t()) ^ 2 * m, from_b = of_b_t<B_CHUNKS>(b, lane_row()) ^ 2 * n;
    add<K>([&](u32 (&words)[4], int s, int k) { ldmatrix_trans(words, (from_a + k * A_CHUNKS * 16) ^ 32 * s); },
           [&](u32 (&words)[4], int k, int t) { ldmatrix_trans(words, (from_b + k * B_CHUNKS * 16) ^ 16 * t); });
  }

  // `visit(number, next number, column)` for those of row m + 8 r + lane() / 4, the r-th of this thread, where the first
  // column is n.
  template <typename Visit>
  __device__ __forceinline__ void each_of_row(int r, int n, Visit visit) {
#pragma unroll
    for (int t = 0; t < N; ++t)
      visit(of[r / 2][t][r % 2 * 2], of[r / 2][t][r % 2 * 2 + 1], n + 8 * t + 2 * (lane() & 3));
  }

  // `visit(number, next number, row, column)`, where the first row is m and the first column n.
  template <typename Visit>
  __device__ __forceinline__ void each_pair(int m, int n, Visit visit) {
#pragma unroll
    for (int r = 0; r < 2 * M; ++r)
      each_of_row(r, n, [&](float first, float second, int column) {
        visit(first, second, m + 8 * r + (lane() >> 2), column);
      });
  }

  // To rows of `columns` float32.
  __device__ __forceinline__ void store(float* to, int m, int n, int columns) {
    each_pair(m, n, [&](float first, float second, int row, int column) {
      *(float2*)(to + row * columns + column) = make_float2(first, second);
    });
  }
};

// The sums of rows of B[K][n..n+16]: of a product with ones, every row of which is the same.
struct ColumnSums {
  Sums<1, 2> sums;

  template <int K, int B_CHUNKS>
  __device__ __forceinline__ void add(const char* b, int n) {
    constexpr u32 ONES = 0x3f803f80u;  // two numbers 1 in bfloat16
    const u32 from_b = of_b_t<B_CHUNKS>(b, lane_row()) ^ 2 * n;
    sums.add<K>([](u32 (&words)[4], int, int) { words[0] = words[1] = words[2] = words[3] = ONES; },
                [&](u32 (&words)[4], int k, int) { ldmatrix_trans(words, from_b + k * B_CHUNKS * 16); });
  }

  __device__ __forceinline__ void store(float* to, int n) {
    sums.each_pair(0, n, [&](float first, float second, int row, int column) {
      if (row == 0) *(float2*)(to + column) = make_float2(first, second);
    });
  }
};

// A warp's part of a tile of 64 rows and 128 columns.
constexpr int PART = 32;  // rows, and columns
typedef Sums<2, 4> PartSums;
__device__ __forceinline__ int part_row() { return (warp() & 1) * PART; }
__device__ __forceinline__ int part_column() { return (warp() >> 1) * PART; }

// A thread has 32 numbers of a row: pieces `quarter`, quarter + 4, ... of row threadIdx.x / 4.
struct Quarter {
  uint4 pieces[4];
};

__device__ __forceinline__ int quarter_row() { return threadIdx.x >> 2; }
__device__ __forceinline__ int quarter_chunk(int i) { return (threadIdx.x & 3) + 4 * i; }

__device__ __forceinline__ Quarter load_quarter(const uint4* rows, long long first, int num_rows) {
  Quarter own;
  const bool is_there = quarter_row() < num_rows;
#pragma unroll
  for (int i = 0; i < 4; ++i)
    own.pieces[i] = is_there ? rows[(first + quarter_row()) * CHUNKS + quarter_chunk(i)] : make_uint4(0, 0, 0, 0);
  return own;
}

// From a tile: what this thread itself copied there by `begin_copy`.
__device__ __forceinline__ Quarter copied_quarter(const char* tile) {
  Quarter own;
#pragma unroll
  for (int i = 0; i < 4; ++i) own.pieces[i] = *(const uint4*)(tile + at<CHUNKS>(quarter_row(), quarter_chunk(i)));
  return own;
}

// Begins to copy rows into a tile; rows that are not there become zeros.
__device__ __forceinline__ void begin_copy(char* tile, const uint4* rows, long long first, int num_rows) {
  const bool is_there = quarter_row() < num_rows;
#pragma unroll
  for (int i = 0; i < 4; ++i) {
    const int chunk = quarter_chunk(i);
    copy_async(tile + at<CHUNKS>(quarter_row(), chunk),
               rows + (is_there ? (first + quarter_row()) * CHUNKS + chunk : 0), is_there);
  }
}

// Writes rows of a tile to memory.
__device__ __forceinline__ void store_rows(const char* tile, uint4* rows, long long first, int num_rows) {
  if (quarter_row() >= num_rows) return;
#pragma unroll
  for (int i = 0; i < 4; ++i)
    rows[(first + quarter_row()) * CHUNKS + quarter_chunk(i)] =
        *(const uint4*)(tile + at<CHUNKS>(quarter_row(), quarter_chunk(i)));
}

// Copies `num_chunks` pieces of 16 bytes into a tile with rows of ROW_CHUNKS: weights.
template <int ROW_CHUNKS>
__device__ __forceinline__ void load_weights(char* tile, const uint4* from, int num_chunks) {
  for (int i = threadIdx.x; i < num_chunks; i += THREADS)
    *(uint4*)(tile + at<ROW_CHUNKS>(i / ROW_CHUNKS, i % ROW_CHUNKS)) = from[i];
}

__device__ __forceinline__ float sum_of_four_lanes(float x) {
  x += from_lane(x, 1);
  return x + from_lane(x, 2);
}

// Layer norm without scale and offset: `tile` gets (x - mean) / sqrt(variance + epsilon), rounded; returns 1 / sqrt(...)
// of the row of this thread.
__device__ __forceinline__ float normalise(const Quarter& own, char* tile) {
  float sum = 0.0f, squares = 0.0f;
#pragma unroll
  for (int i = 0; i < 4; ++i) {
    const u32 words[4] = {own.pieces[i].x, own.pieces[i].y, own.pieces[i].z, own.pieces[i].w};
#pragma unroll
    for (int j = 0; j < 4; ++j) sum += low(words[j]) + high(words[j]);
  }
  const float mean = sum_of_four_lanes(sum) * (1.0f / WIDTH);
#pragma unroll
  for (int i = 0; i < 4; ++i) {
    const u32 words[4] = {own.pieces[i].x, own.pieces[i].y, own.pieces[i].z, own.pieces[i].w};
#pragma unroll
    for (int j = 0; j < 4; ++j) {
      const float a = low(words[j]) - mean, b = high(words[j]) - mean;
      squares += a * a + b * b;
    }
  }
  const float inverse_std = rsqrtf(sum_of_four_lanes(squares) * (1.0f / WIDTH) + NORM_EPSILON);
#pragma unroll
  for (int i = 0; i < 4; ++i) {
    const u32 words[4] = {own.pieces[i].x, own.pieces[i].y, own.pieces[i].z, own.pieces[i].w};
    u32 normal[4];
#pragma unroll
    for (int j = 0; j < 4; ++j)
      normal[j] = pack((low(words[j]) - mean) * inverse_std, (high(words[j]) - mean) * inverse_std);
    *(uint4*)(tile + at<CHUNKS>(quarter_row(), quarter_chunk(i))) =
        make_uint4(normal[0], normal[1], normal[2], normal[3]);
  }
  return inverse_std;
}

// Of a tile whose rows were normalised, on the way back.
struct NormGradient {
  float inverse_std[ROWS];
  float of_grad[WIDTH / PART][ROWS], of_grad_times_normal[WIDTH / PART][ROWS];  // sums over the columns of a part

  // First half, for a warp's part of the gradient of the normalised rows. All threads have to come before the second.
  __device__ __forceinline__ void begin(PartSums& grad, char* normal) {
#pragma unroll
    for (int r = 0; r < 4; ++r) {
      const int row = part_row() + 8 * r + (lane() >> 2);
      float sum = 0.0f, with_normal = 0.0f;
      grad.each_of_row(r, part_column(), [&](float first, float second, int column) {
        const u32 pair = *pair_at<CHUNKS>(normal, row, column);
        sum += first + second;
        with_normal += first * low(pair) + second * high(pair);
      });
      sum = sum_of_four_lanes(sum);
      with_normal = sum_of_four_lanes(with_normal);
      if ((lane() & 3) == 0) {
        of_grad[warp() >> 1][row] = sum;
        of_grad_times_normal[warp() >> 1][row] = with_normal;
      }
    }
  }

  // stream += the gradient of what was normalised.
  __device__ __forceinline__ void finish(PartSums& grad, char* normal, char* stream) {
#pragma unroll
    for (int r = 0; r < 4; ++r) {
      const int row = part_row() + 8 * r + (lane() >> 2);
      float mean = 0.0f, along = 0.0f;
#pragma unroll
      for (int part = 0; part < WIDTH / PART; ++part) {
        mean += of_grad[part][row];
        along += of_grad_times_normal[part][row];
      }
      mean *= 1.0f / WIDTH;
      along *= 1.0f / WIDTH;
      const float scale = inverse_std[row];
      grad.each_of_row(r, part_column(), [&](float first, float second, int column) {
        const u32 pair = *pair_at<CHUNKS>(normal, row, column);
        u32* to = pair_at<CHUNKS>(stream, row, column);
        *to = pack(low(*to) + (first - mean - low(pair) * along) * scale,
                   high(*to) + (second - mean - high(pair) * along) * scale);
      });
    }
  }
};

// Of two numbers, those of which the sum before relu is above 0.
__device__ __forceinline__ u32 kept_by_relu(float first, float second) {
  return (first > 0.0f ? 0x0000ffffu : 0u) | (second > 0.0f ? 0xffff0000u : 0u);
}
