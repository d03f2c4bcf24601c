"""An RTSP server with one test picture: `server.py PORT CODEC` serves rtsp://127.0.0.1:PORT/CODEC (h264 or jpeg) at 20 frames
a second. Prints a line when it listens."""

import sys

import gi

gi.require_version("Gst", "1.0")
gi.require_version("GstRtspServer", "1.0")
from gi.repository import GLib, Gst, GstRtspServer  # noqa: E402

ENCODERS = {
    "h264": "x264enc tune=zerolatency speed-preset=ultrafast key-int-max=20 ! rtph264pay name=pay0 pt=96",
    "jpeg": "jpegenc ! rtpjpegpay name=pay0 pt=26",
}

port, codec = sys.argv[1:]
Gst.init(None)
server = GstRtspServer.RTSPServer()
server.set_address("127.0.0.1")
server.set_service(port)
factory = GstRtspServer.RTSPMediaFactory()
picture = "videotestsrc is-live=true ! video/x-raw,format=I420,width=320,height=240,framerate=20/1"
factory.set_launch(f"( {picture} ! {ENCODERS[codec]} )")
factory.set_shared(True)
server.get_mount_points().add_factory(f"/{codec}", factory)
server.attach(None)
print("listening", flush=True)
GLib.MainLoop().run()
