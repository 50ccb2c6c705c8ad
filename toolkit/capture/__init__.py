"""From video and flight logs to frames: decoding, telemetry, keyframes."""
