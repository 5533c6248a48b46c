// The feed-forward part of a layer, between a stream x and the gate that lets y into it:
//
//     y = relu(normalise(x) W + b)
//
// and its gradient: of y's and of the stream's own gradient those of x, W and b. Nothing but x is kept for it; what the
// backward pass needs is computed again. x, y and their gradients are [rows, 128] in bfloat16, W is [128, 128] in
// bfloat16 (norm folded in), b float32. Sums are float32. Each block adds up its own part of the gradients of W and b.

#include "tile.cuh"

struct FeedForwardShared {
  char weights[WIDTH * WIDTH * 2];
  char tiles[2][TILE_BYTES];  // in turns, so that one is written while the other is still stored
};

struct FeedForwardGradientShared {
  char weights[WIDTH * WIDTH * 2];
  char x[TILE_BYTES];  // of the next tile
  char normal[TILE_BYTES];
  char grad[TILE_BYTES];    // of y
  char stream[TILE_BYTES];  // the gradient of the stream, then of x
  NormGradient norm;
};

SHARED_BYTES(feed_forward, FeedForwardShared)
SHARED_BYTES(feed_forward_gradient, FeedForwardGradientShared)

extern "C" __global__ void __launch_bounds__(THREADS, 3)
    feed_forward(const int* num_rows, const uint4* x, const uint4* kernel, const float* bias, uint4* y) {
  SHARED_MEMORY(FeedForwardShared, own);
  const int m = part_row(), n = part_column(), rows = *num_rows, stride = gridDim.x * ROWS;
  load_weights<CHUNKS>(own.weights, kernel, WIDTH * CHUNKS);

  int first = blockIdx.x * ROWS;
  Quarter next = load_quarter(x, first, rows - first);
  for (int number = 0; first < rows; first += stride, ++number) {
    char* tile = own.tiles[number & 1];
    normalise(next, tile);
    __syncthreads();
    next = load_quarter(x, first + stride, rows - first - stride);

    PartSums sums;
    sums.clear();
    sums.add_product<WIDTH, CHUNKS, CHUNKS>(tile, m, own.weights, n);
    __syncthreads();  // every warp has read the tile
    sums.each_pair(m, n, [&](float one, float two, int row, int column) {
      *pair_at<CHUNKS>(tile, row, column) = pack(relu(one + bias[column]), relu(two + bias[column + 1]));
    });
    __syncthreads();
    store_rows(tile, y, first, rows - first);
  }
}

// grad_kernel: [blocks, 128, 128], grad_bias: [blocks, 128], of each block.
extern "C" __global__ void __launch_bounds__(THREADS, 2)
    feed_forward_gradient(const int* num_rows, const uint4* x, const uint4* grad_stream, const uint4* grad_y,
                          const uint4* kernel, const float* bias, uint4* grad_x, float* grad_kernel, float* grad_bias) {
  SHARED_MEMORY(FeedForwardGradientShared, own);
  const int m = part_row(), n = part_column(), rows = *num_rows, stride = gridDim.x * ROWS;
  load_weights<CHUNKS>(own.weights, kernel, WIDTH * CHUNKS);

  // Of this warp: 32 rows and 64 columns of the gradient of W, 16 numbers of that of b.
  const int kernel_row = (warp() >> 1) * 32, kernel_column = (warp() & 1) * 64;
  Sums<2, 8> of_kernel;
  ColumnSums of_bias;
  of_kernel.clear();
  of_bias.sums.clear();
  int first = blockIdx.x * ROWS;
  begin_copy(own.x, x, first, rows - first);
  begin_copy(own.grad, grad_y, first, rows - first);
  end_group();
  for (; first < rows; first += stride) {
    const int here = rows - first;
    wait_for_copies<0>();
    __syncthreads();  // of the tile before, everything is stored
    begin_copy(own.stream, grad_stream, first, here);
    end_group();
    const float inverse_std = normalise(copied_quarter(own.x), own.normal);
    if ((threadIdx.x & 3) == 0) own.norm.inverse_std[quarter_row()] = inverse_std;
    begin_copy(own.x, x, first + stride, here - stride);  // where this thread has read
    end_group();
    __syncthreads();

    {  // Of y, what reaches the sum before relu.
      PartSums sums;
      sums.clear();
      sums.add_product<WIDTH, CHUNKS, CHUNKS>(own.normal, m, own.weights, n);
      sums.each_pair(m, n, [&](float one, float two, int row, int column) {
        *pair_at<CHUNKS>(own.grad, row, column) &= kept_by_relu(one + bias[column], two + bias[column + 1]);
      });
    }
    __syncthreads();
    of_kernel.add_outer<ROWS, CHUNKS, CHUNKS>(own.normal, kernel_row, own.grad, kernel_column);
    of_bias.add<ROWS, CHUNKS>(own.grad, warp() * 16);
    PartSums of_normal;
    of_normal.clear();
    of_normal.add_transposed<WIDTH, CHUNKS, CHUNKS>(own.grad, m, own.weights, n);
    own.norm.begin(of_normal, own.normal);
    wait_for_copies<1>();  // the stream is there; the next x may be under way
    __syncthreads();
    begin_copy(own.grad, grad_y, first + stride, here - stride);  // which no warp reads any more
    end_group();
    own.norm.finish(of_normal, own.normal, own.stream);
    __syncthreads();
    store_rows(own.stream, grad_x, first, here);
  }
  of_kernel.store(grad_kernel + (long long)blockIdx.x * WIDTH * WIDTH, kernel_row, kernel_column, WIDTH);
  of_bias.store(grad_bias + blockIdx.x * WIDTH, warp() * 16);
}
