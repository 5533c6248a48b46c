"""Control under inference delay: policies that give chunks of actions, and how worlds play while one is computed.

    chunk_policy     policy of chunks (flow matching): its network, units and checkpoint
    flow_matching    interpolation, loss, integration
    guidance         RTC: a flow pulled towards what is left of the chunk before
    methods          how the next chunk is chosen: plain, bidirectional decoding, RTC, training-time RTC
    execution        worlds that go on while the next chunk is computed
    demonstrations   samples of data sets that `kinetix-dist collect` wrote
    windows          chunks of them; cloning: training on these
    curve, picture   solve rates over delays

Time of control is counted in environment steps, flow time from 0 (noise) to 1 (data). docs/delay.md has the formulas
with their sources.
"""
