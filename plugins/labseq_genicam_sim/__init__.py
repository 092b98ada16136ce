"""Aravis' own simulated GigE Vision camera on loopback, in a separate process, for ``labseq_genicam``.

:class:`labseq_genicam_sim.fake.FakeCamera` starts it. Packets, registers, heartbeat and control privilege
come from Aravis 0.8.26. The description of the features is ours (:mod:`labseq_genicam_sim.description`), and
the parent process makes the pixels. This module imports nothing, so that the camera's process starts fast.

=================  =================================================================================
feature            behaviour
=================  =================================================================================
region             any on the sensor, in steps of one pixel
reversed order     passed to the parent only, columns reversed at the start
binning            1 to 8 each way, by the parent. It changes the bounds of the region
pixel format       Mono8, Mono10, Mono12, Mono16, unpacked, with larger values clipped
exposure           10 us to 10 s in steps of 1 us, passed to the parent only. A frame takes no time
gain               0 to 1000 in steps of 0.001, passed to the parent only, which uses it
frame rate         0.1 to 1000 frames/s without a trigger. Late frames are left out
software trigger   polled 250 times a second, and within 0.1 s after the acquisition has started.
                   Two between polls count as one
line trigger       Line1, which is connected to nothing
frame numbers      16 bits, 1 after 65535, beginning with 65401
time stamps        this machine's clock when a frame begins, in nanoseconds since 1970
packets            of any size up to 65535 bytes, without pauses, and none is sent again
control            by one client. Others get no answer, and stop trying after 5 s. It is free again 3 s
                   after the last heartbeat
not simulated      sequences of n frames, chunk data, events, temperature, shutter
=================  =================================================================================

One thread does everything, so while a frame is made, the camera answers nothing. Failures are chosen by
:class:`labseq_genicam_sim.messages.Faults`.

On Linux each camera has its own address, and a frame is sent at once, as far as a well configured socket has
room for it. On other systems there is one camera per machine at a time, and packets may be lost. That was not
tested.
"""
