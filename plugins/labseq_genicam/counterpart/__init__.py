"""A simulated GigE Vision camera on loopback: Aravis' own, in a process of its own.

The parent's side is :class:`labseq_genicam.counterpart.fake.FakeCamera`. Packets, registers,
heartbeat and control privilege are those of Aravis 0.8.26; the description of the features is
ours (:mod:`labseq_genicam.counterpart.description`), the pixels are the parent's.

=================  =================================================================================
feature            what it does
=================  =================================================================================
region             any on the sensor, in steps of one pixel
binning            1 to 8 each way; changes the bounds of the region, and is told to the parent, who bins
pixel format       Mono8, Mono10, Mono12, Mono16, unpacked; greater values are clipped
exposure           10 us to 10 s in steps of 1 us; told to the parent only: a frame takes no time
gain               0 to 1000 in steps of 0.001; told to the parent only, who knows what it means
free running       0.1 to 1000 frames/s; a frame that is not made in time is left out
software trigger   looked for 250 times a second, and within 0.1 s after the acquisition has started;
                   two in between are one
line trigger       Line1, to which no wire leads
frame numbers      16 bits, 1 after 65535; 65401 is the first
time stamps        this machine's clock when a frame is begun, in nanoseconds since 1970
packets            of any size up to 65535 bytes; no pause between them, and none is sent again
control            by one client; others are not answered, and give up after 5 s. It is free again 3 s
                   after the last heartbeat
not there          sequences of n frames, chunk data, events, temperature, shutter
=================  =================================================================================

One thread does it all: while a frame is made, nothing else is answered. What goes wrong, and
how, is told by :class:`labseq_genicam.counterpart.faults.Faults`.

On Linux each camera has an address of its own, and packets wait until the receiver has room.
Elsewhere there is one on a machine at a time, and packets may be lost; that was not tried.
"""
