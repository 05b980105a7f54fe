"""A node that does what a re-simulation cannot go on with, at its 20th message; the argument states what."""

import ctypes
import fcntl
import os
import platform
import signal
import subprocess
import sys
import threading

import rclpy
from rclpy.node import Node
from std_msgs.msg import String

EXIT_GROUP = 231 if platform.machine() == "x86_64" else 94


class Faulty(Node):  # type: ignore[misc]
    def __init__(self, what: str) -> None:
        super().__init__("faulty")
        self.publisher = self.create_publisher(String, "/out", 10)
        self.count = 0
        self.fail = getattr(self, what)
        topic = {"asks": "/other", "mistypes": "/inn"}.get(what, "/in")
        self.create_subscription(String, topic, self.take, 10)

    def take(self, message: String) -> None:
        self.count += 1
        self.publisher.publish(message)
        if self.count == 20:
            self.fail()

    def asks(self) -> None:
        pass

    mistypes = never_spins = asks

    def ends(self) -> None:
        sys.exit(0)

    def raises(self) -> None:
        raise ValueError("found 3 wheels, expected 4:\none is lost")

    def crashes(self) -> None:
        os.kill(os.getpid(), 11)

    def hangs(self) -> None:
        threading.Lock().acquire() and threading.Event().wait()

    def loops(self) -> None:
        while True:
            pass

    def is_stopped(self) -> None:
        os.kill(os.getpid(), signal.SIGTERM)

    def is_killed(self) -> None:
        os.kill(os.getpid(), signal.SIGKILL)

    def stops(self) -> None:
        os.kill(os.getpid(), signal.SIGSTOP)

    def exits(self) -> None:
        """The call itself, which no library sees."""
        ctypes.CDLL(None).syscall(EXIT_GROUP, 4)

    def becomes(self) -> None:
        os.execlp("sh", "sh", "-c", "exit 5")

    def becomes_a_sleeper(self) -> None:
        os.execlp("sleep", "sleep", "1000")

    def becomes_itself(self) -> None:
        os.execv(sys.executable, [sys.executable, __file__, "asks_git"])

    def forks(self) -> None:
        """Both go on."""
        os.fork()

    def starts_a_node(self) -> None:
        self.child = subprocess.Popen([sys.executable, __file__, "asks"])

    def spawns(self) -> None:
        self.child = subprocess.Popen(["sleep", "1000"])

    def daemonizes(self) -> None:
        """The daemon keeps the standard error open, but not the environment."""
        if not os.fork():
            os.setsid()
            if not os.fork():
                os.execve("/bin/sleep", [os.environ["MARK_OF_THIS_TEST"], "1000"], {})
            os._exit(0)

    def leaves(self) -> None:
        """And so does this child."""
        subprocess.Popen(["sleep", "1000"], start_new_session=True)
        os._exit(3)

    def asks_git(self) -> None:
        """A process that ends is no fault."""
        text = subprocess.run(["echo", "v1.2"], capture_output=True, text=True, check=True).stdout
        self.publisher.publish(String(data=text.strip()))

    def compiles(self) -> None:
        """Nor is one that computes for longer."""
        busy = "import time\nuntil = time.process_time() + 2\nwhile time.process_time() < until: pass"
        subprocess.run(["sh", "-c", '"$0" -c "$1"; true', sys.executable, busy], check=True)
        self.publisher.publish(String(data="compiled"))

    def futex(self) -> None:
        """A thread waits in a way that only the kernel knows about."""
        word, limit = ctypes.c_int(0), (ctypes.c_long * 2)(1, 0)
        futex, wait = 202, 0
        arguments = futex, ctypes.byref(word), wait, 0, limit
        threading.Thread(target=ctypes.CDLL(None).syscall, args=arguments, daemon=True).start()

    def mutex(self) -> None:
        libc, mutex = ctypes.CDLL(None), (ctypes.c_char * 64)()
        libc.pthread_mutex_lock(mutex)
        until = (ctypes.c_long * 2)(2**32, 0)
        threading.Thread(target=libc.pthread_mutex_timedlock, args=(mutex, until), daemon=True).start()

    def sets_timers(self) -> None:
        """Those of the system; one was set before."""
        libc, until = ctypes.CDLL(None), (ctypes.c_long * 4)(0, 0, 1000, 0)
        signal.alarm(1000)
        timer = ctypes.c_void_p()
        libc.timer_create(1, None, ctypes.byref(timer))
        libc.timer_settime(timer, 0, until, None)
        libc.timerfd_settime(libc.timerfd_create(1, 0), 0, until, None)

    def locks(self) -> None:
        """Another process has the lock for a while."""
        with open(sys.argv[2], "a") as file:
            file.write("waits")
            file.flush()
            fcntl.flock(file, fcntl.LOCK_EX)
        self.publisher.publish(String(data="locked"))

    def floods(self) -> None:
        while True:
            self.publisher.publish(String(data="flood"))

    def talks(self) -> None:
        import socket

        socket.create_server(("127.0.0.1", 0)).close()


if sys.argv[1] == "sets_timers":
    signal.setitimer(signal.ITIMER_VIRTUAL, 1000)
rclpy.init()
try:
    node = Faulty(sys.argv[1])
    if sys.argv[1] != "never_spins":
        rclpy.spin(node)
except KeyboardInterrupt:
    pass
