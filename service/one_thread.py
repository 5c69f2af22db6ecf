"""Let libraries compute in one thread in a process that imports this before them.

A limit on memory counts the stack and the buffers of each thread, and cores may be many.
"""

import os

from service.child import ONE_THREAD

os.environ |= ONE_THREAD
