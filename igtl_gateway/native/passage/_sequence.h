/* The passage, its sequence lock, and the numbers and times of entries.
 *
 * Locks, in the order in which a thread may take them:
 *   reading of a link -> sequence -> recorder -> sending of links -> events
 * The sequence lock guards the streams, the numbers and all counts of streams.  Python takes it through the hub.
 */
#ifndef IGTL_GATEWAY_PASSAGE_SEQUENCE_H
#define IGTL_GATEWAY_PASSAGE_SEQUENCE_H

#include <stdatomic.h>
#include <sys/syscall.h>
#include <unistd.h>

#include "../kernel/_queue.h"
#include "_limits.h"
#include "_lock.h"
#include "_rcl.h"

#define SEQUENCE_NS 100000 /* the longest wait of a thread of the middleware for this lock, in which it receives nothing */

typedef struct Link Link;
typedef struct Subscription Subscription;
typedef struct Stream Stream;

enum { TO_ROS, TO_IGTL };

typedef struct Passage {
    PyObject_HEAD
    pthread_mutex_t sequence;
    _Atomic pid_t owner;    /* the thread that has the sequence lock; 0: none, or it need not be known */
    long long seq;          /* number of the last entry */
    long long stamp_ns;     /* gateway time of the last entry, UTC */
    long long last_ns;      /* gateway time of the last input, UTC */
    long long ahead_ns;     /* gateway time less the time of the host's clock */
    char builds_all;        /* outputs without a subscriber are built, too */
    char closed;            /* every message goes to Python */
    rcl_take_function take;
    rcl_publish_function publish;
    rcl_count_function subscribers;
    char is_recorded;
    struct queue queue;     /* of the recorder */
    Lock *queue_lock;
    PyObject *queue_memory; /* keeps the mapping */
    ssize_t largest_recorded; /* bytes of a message with its outputs; written with the lock of the queue, atomic */
    char presses;             /* Python has to look after the queue when the message has passed; atomic */
    uint8_t *scratch;       /* MAX_OUTPUTS outputs, guarded by the sequence lock */
    uint32_t times[2][TIMED_PHASES][TIME_BUCKETS]; /* of messages to ROS and to OpenIGTLink; atomic */
    /* links and subscriptions that Python has to look at */
    pthread_mutex_t events;
    pthread_cond_t taken_over;
    int epoll, wake;
    Link *noted;            /* list of links with events */
    Link *with_large;       /* list of links that have read a large message since wait_large */
    Stream *left_streams;   /* list of those that nothing refers to, but were in use; guarded by the GIL */
    long long large_bytes;  /* of large messages that wait for Python */
    pthread_cond_t large_read;
    pthread_cond_t pressed;
    int attends;            /* Python has to look after the recorder's queue */
    Link *closed_links;     /* list of links that the reading thread may still know; it owns a reference to each */
    Subscription *ready;    /* list of subscriptions that Python owns and that have messages */
    Subscription **ready_end;
    int woken_links, woken_subscriptions, woken_large, woken_recorder;
    struct unfilled *unfilled[2], **unfilled_end[2]; /* large messages of each direction, oldest first */
    int unfilled_count[2];
    /* of the reading thread alone */
    Link *waiting;   /* list of links that wait for a turn */
    Link *limited;   /* list of links that are read again at a time */
    int64_t turn_ns; /* where the turns are, see turns.py */
    int64_t used_ns; /* CPU time of the thread after the last turn */
} Passage;

static pid_t this_thread(void)
{
    static _Thread_local pid_t thread;
    if (!thread)
        thread = (pid_t)syscall(SYS_gettid);
    return thread;
}

/* For a thread of the middleware.  It receives nothing while it waits, so each message would wait for the lock, and
 * those behind it for all of them; another thread takes all that has come meanwhile at once. */
static int lock_sequence(Passage *self)
{
    if (!lock_within(&self->sequence, SEQUENCE_NS))
        return 0;
    atomic_store_explicit(&self->owner, this_thread(), memory_order_relaxed);
    return 1;
}

/* For the thread that reads the links, which has no locks of the middleware then. */
static void wait_for_sequence(Passage *self)
{
    pthread_mutex_lock(&self->sequence);
    atomic_store_explicit(&self->owner, this_thread(), memory_order_relaxed);
}

static void unlock_sequence(Passage *self)
{
    atomic_store_explicit(&self->owner, 0, memory_order_relaxed);
    pthread_mutex_unlock(&self->sequence);
}

static int has_sequence(Passage *self)
{
    return atomic_load_explicit(&self->owner, memory_order_relaxed) == this_thread();
}

/* What a message waits for.  MIDDLEWARE: from the source stamp until it is taken (to OpenIGTLink only). */
enum { MIDDLEWARE, SEQUENCE, CONVERSION, OUTPUT, RECORDING };

/* Count a time, in buckets of a quarter of a power of two. */
static void count_time(Passage *self, int direction, int phase, int64_t ns)
{
    uint64_t time = ns < 8 ? 8 : (uint64_t)ns;
    int power = 63 - __builtin_clzll(time);
    __atomic_add_fetch(&self->times[direction][phase][4 * power + (int)(time >> (power - 2) & 3)], 1, __ATOMIC_RELAXED);
}

/* Count the phases of a message but the last one. */
static void count_times(Passage *self, int direction, int64_t sequence_ns, int64_t conversion_ns, int64_t output_ns)
{
    count_time(self, direction, SEQUENCE, sequence_ns);
    count_time(self, direction, CONVERSION, conversion_ns);
    count_time(self, direction, OUTPUT, output_ns);
}

/* Count the last phase, which ends now, of a message that had passed at this monotonic time. */
static void count_recording(Passage *self, int direction, int64_t passed_ns)
{
    count_time(self, direction, RECORDING, clock_ns(CLOCK_MONOTONIC) - passed_ns);
}

/* The time of an input; 0: the clock went back, which Python notes. */
static int64_t time_of_input(Passage *self, int64_t *stamp_ns)
{
    int64_t now_ns = clock_ns(CLOCK_REALTIME) + self->ahead_ns;
    if (self->closed || now_ns < self->last_ns)
        return 0;
    *stamp_ns = now_ns > self->stamp_ns ? now_ns : self->stamp_ns + 1;
    return now_ns;
}

/* Number an input of this time and its outputs; return the number of the input. */
static uint64_t take_numbers(Passage *self, int outputs, int64_t now_ns, int64_t stamp_ns)
{
    uint64_t seq = (uint64_t)self->seq + 1;
    self->last_ns = now_ns;
    self->seq += 1 + outputs;
    self->stamp_ns = stamp_ns + outputs;
    return seq;
}

#endif
