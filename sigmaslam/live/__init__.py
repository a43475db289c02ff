"""What sees a run while it goes on: streams, videos, viewers, a web page."""
