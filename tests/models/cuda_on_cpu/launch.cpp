// launch_KERNEL(grid, threads, bytes of shared memory, arguments) for each kernel of SOURCE, which OF_... names too.
#define ON_CPU
#include SOURCE

#define LAUNCH(kernel)                                                                       \
  extern "C" void launch_##kernel(int grid, int threads, int bytes, void** arguments) {      \
    on_cpu::launch(kernel, grid, threads, bytes, arguments);                                 \
  }

#if defined(OF_ATTENTION)
LAUNCH(attention)
LAUNCH(attention_gradient)
#elif defined(OF_ENCODERS)
LAUNCH(encode)
LAUNCH(encode_and_keep)
LAUNCH(encode_gradient)
#elif defined(OF_FEED_FORWARD)
LAUNCH(feed_forward)
LAUNCH(feed_forward_gradient)
#elif defined(OF_MESSAGES)
LAUNCH(messages)
LAUNCH(messages_gradient)
LAUNCH(messages_weight_gradient)
#endif
