"""A conformance run: sessions with a device, the judging of cases, workers."""
