from semantic_mapper.drivers.oak.devices import load_depthai

load_depthai()  # before a test imports DepthAI itself: it is told here to leave signals alone
