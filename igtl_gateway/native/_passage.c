/* The native passage: messages of compiled streams, from the socket or the DDS reader to the other side, without the GIL.
 *
 * igtl_gateway/native/passage/__init__.py documents what it is for.  Everything here is optional: a message that is not as its
 * stream expects goes to Python, which has the same streams, and gives the same entries.
 *
 * Locks, in the order in which a thread may take them:
 *   reading of a link -> sequence -> recorder -> sending of links -> events
 * The sequence lock guards the streams, the numbers and all counts of streams.  Python takes it through the hub.
 */
#define PY_SSIZE_T_CLEAN
#include <Python.h>
#include <structmember.h>

#include <errno.h>
#include <poll.h>
#include <pthread.h>
#include <stdatomic.h>
#include <stdlib.h>
#include <sys/epoll.h>
#include <sys/eventfd.h>
#include <sys/socket.h>
#include <sys/syscall.h>
#include <sys/uio.h>
#include <time.h>
#include <unistd.h>

#include "_places.h"
#include "_take.h"
#include "_queue.h"

#define NAMES_BYTES 34 /* of a header: version, type, device name */
#define BUCKETS 64
#define MAX_TURNS 64 /* of subscriptions, at once */
#define MAX_OUTPUTS 8
#define MAX_LINKS 64
#define CHUNK_BYTES (64 * 1024)
#define MOST_UNSENT (1024 * 1024) /* that Python has not queued yet */
#define LARGEST_RECEIPT (1024 * 1024) /* of a turn */
#define LARGEST_OUTPUT (256 * 1024)
#define LARGEST_INPUT (32 * 1024)   /* what is larger takes too long for a thread of the middleware */
#define LARGEST_RECEIVED (256 * 1024) /* what is larger takes too long for the thread that reads the links */
#define LARGEST_RECORDED (512 * 1024) /* an input and its outputs, which are copied under the locks */
#define LARGEST_MADE (64 * 1024 * 1024) /* outputs of a message that is converted without the sequence lock */
#define ROOM_AHEAD (2 * 1024 * 1024) /* that small messages should have in the recorder's queue before Python finds more */
#define MAX_PARTS 3 /* of a message that is sent: what is before a picture, the picture, what is after it */
#define MAX_PLACES 70             /* of a sample, see express.py */
#define OBSERVATIONS 256
#define EVENTS 32
#define TIMED_PHASES 5
#define TIME_BUCKETS 256
#define MAX_LARGE_STREAMS 64
#define REMEMBERED 64        /* own messages of a latched topic: more than a late subscription gets of them */
#define REMEMBERED_BYTES 256 /* of their beginning, as in edges/ros/topics.py */
#define MAX_LARGE_WAITING 3 /* messages; then TCP makes the peer wait */
#define MOST_LARGE_BYTES (256LL << 20) /* of all links; then a link waits behind its first one */
#define MAX_UNFILLED 3 /* messages of a direction; then the oldest is copied to the recorder at once */
#define READ_BYTES_PER_US 1500 /* by the receiver of a large message: its copies and ours would share the memory's bandwidth */
#define ROOM_NS 3000000 /* the longest wait for a peer that is about to take the rest of a large message */
#define LOCK_NS 2000000 /* the longest wait of a thread of the middleware */
#define SEQUENCE_NS 100000 /* its longest wait for the sequence lock, in which it receives nothing */
#define BATCH_NS 3000000 /* messages of ROS that wait pass with one taking of the sequence lock, for this time at most */
#define PART 8 /* of its time that a turn costs which leaves nothing */
#define PAUSE_NS 1000000 /* the shortest pause of a link that sends more than it may */
#define NOTED_EVERY_NS NS_PER_S /* pauses are reported to Python */
#define QUANTUM_NS 100000 /* a turn of a link ends after the message with which it has lasted this long */

/* As in guarded_stream.py and timing.py. */
#define LOOK_NS (100 * 1000000LL)
#define FUTURE_NS (100 * 1000000LL)
#define STILL_LOOKS 20
#define LEAST_SUSPECT 100.0 /* a factor between two translations from which on Python judges */

static int64_t clock_ns(clockid_t clock)
{
    struct timespec now;
    clock_gettime(clock, &now);
    return now.tv_sec * NS_PER_S + now.tv_nsec;
}

/* Counts that Python takes without a lock. */
static void add(long long *count) { __atomic_add_fetch(count, 1, __ATOMIC_RELAXED); }

static long long taken(long long *count) { return __atomic_exchange_n(count, 0, __ATOMIC_RELAXED); }

/* -- locks ---------------------------------------------------------------------------------------------------------- */

/* A thread that waits for the lock lends its priority to the one that has it. */
static int begin_mutex(pthread_mutex_t *mutex)
{
    pthread_mutexattr_t attributes;
    if (pthread_mutexattr_init(&attributes))
        return -1;
    pthread_mutexattr_setprotocol(&attributes, PTHREAD_PRIO_INHERIT);
    int failed = pthread_mutex_init(mutex, &attributes);
    pthread_mutexattr_destroy(&attributes);
    return failed ? -1 : 0;
}

/* A condition whose timed waits are by the monotonic clock. */
static int begin_condition(pthread_cond_t *condition)
{
    pthread_condattr_t attributes;
    if (pthread_condattr_init(&attributes))
        return -1;
    pthread_condattr_setclock(&attributes, CLOCK_MONOTONIC);
    int failed = pthread_cond_init(condition, &attributes);
    pthread_condattr_destroy(&attributes);
    return failed ? -1 : 0;
}

/* Lock with the GIL held by the caller, who keeps it unless the lock has to be waited for. */
static void lock_from_python(pthread_mutex_t *mutex)
{
    if (pthread_mutex_trylock(mutex) == 0)
        return;
    Py_BEGIN_ALLOW_THREADS
    pthread_mutex_lock(mutex);
    Py_END_ALLOW_THREADS
}

/* Lock within some time; 0: it took longer.  A thread of the middleware that calls us has locks of its own: a thread
 * that has ours and waits for the GIL, and one that has the GIL and waits for theirs, would wait forever. */
static int lock_within(pthread_mutex_t *mutex, long ns)
{
    if (pthread_mutex_trylock(mutex) == 0)
        return 1;
    struct timespec until;
    clock_gettime(CLOCK_REALTIME, &until);
    until.tv_nsec += ns;
    until.tv_sec += until.tv_nsec / NS_PER_S;
    until.tv_nsec %= NS_PER_S;
    return pthread_mutex_timedlock(mutex, &until) == 0;
}

static int lock_briefly(pthread_mutex_t *mutex) { return lock_within(mutex, LOCK_NS); }

typedef struct {
    PyObject_HEAD
    pthread_mutex_t mutex;
} Lock;

static PyObject *lock_new(PyTypeObject *type, PyObject *args, PyObject *keywords)
{
    (void)args, (void)keywords;
    Lock *self = (Lock *)type->tp_alloc(type, 0);
    if (self && begin_mutex(&self->mutex)) {
        Py_DECREF(self);
        return PyErr_NoMemory();
    }
    return (PyObject *)self;
}

static void lock_dealloc(Lock *self)
{
    pthread_mutex_destroy(&self->mutex);
    Py_TYPE(self)->tp_free((PyObject *)self);
}

static PyObject *lock_enter(Lock *self, PyObject *nothing)
{
    (void)nothing;
    lock_from_python(&self->mutex);
    return Py_NewRef((PyObject *)self);
}

static PyObject *lock_exit(Lock *self, PyObject *args)
{
    (void)args;
    pthread_mutex_unlock(&self->mutex);
    Py_RETURN_NONE;
}

static PyMethodDef lock_methods[] = {
    {"__enter__", (PyCFunction)lock_enter, METH_NOARGS, NULL},
    {"__exit__", (PyCFunction)lock_exit, METH_VARARGS, NULL},
    {NULL, NULL, 0, NULL},
};

static PyTypeObject Lock_Type = {
    PyVarObject_HEAD_INIT(NULL, 0).tp_name = "igtl_gateway.native._passage.Lock",
    .tp_basicsize = sizeof(Lock),
    .tp_flags = Py_TPFLAGS_DEFAULT,
    .tp_doc = "A lock that Python and the native passage share.",
    .tp_new = lock_new,
    .tp_dealloc = (destructor)lock_dealloc,
    .tp_methods = lock_methods,
};

/* -- the passage ------------------------------------------------------------------------------------------------------ */

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

/* -- where the time goes ---------------------------------------------------------------------------------------------- */

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

/* -- streams ------------------------------------------------------------------------------------------------------------ */

/* The state of igtl_gateway.gateway.guarded_stream.GuardedStream that a message needs. */
typedef struct {
    PyObject_HEAD
    char is_dirty;                  /* messages have changed it since the last collection */
    char watches, judged_by_python; /* the latter: a stale stream */
    char has_place, knows_age;
    int64_t max_age_ns, ahead_ns, last_ns, look_ns, due_ns, seen_ns, arrived_ns;
    int64_t episode_ends_ns; /* after it, Python ends an episode of an oddity, whose other messages pass */
    int64_t still;
    double place[3];
    int observed; /* stamp (0: unset) and time of arrival of the looks that Python has not added to its timing */
    int64_t observations[OBSERVATIONS][2];
} Guard;

/* How a message begins that was published, and when it was (UTC ns). */
struct own_message {
    int64_t begun_ns, ended_ns;
    ssize_t whole, size; /* size: of ``bytes`` */
    uint8_t bytes[REMEMBERED_BYTES];
};

typedef struct {
    PyObject_HEAD
    const void *pointer; /* rcl_publisher_t; NULL: nothing is published */
    long long published, unheard, failed;
    char latched;          /* a later subscription of our own node might get its last messages */
    _Atomic char by_python; /* its messages are Python's */
    pthread_mutex_t publishing;       /* guards what follows, in a latched one, until the end of each call is known */
    struct own_message *own_messages; /* of a latched one: the last REMEMBERED that Python has not taken over */
    uint64_t begun, taken_over, measured; /* numbers of own messages so far */
} Publisher;

/* A large message whose memory the thread that passes it and the stream share; the last one frees it. */
struct kept {
    int owners; /* atomic */
    struct rcl_serialized message; /* only its memory */
};

/* The memory of a message as one that can be shared; NULL: there is no memory for that. */
static struct kept *keep(struct rcl_serialized *message)
{
    struct kept *kept = calloc(1, sizeof *kept);
    if (!kept)
        return NULL;
    kept->owners = 1;
    kept->message = *message;
    return kept;
}

static struct kept *keep_copy(const uint8_t *data, ssize_t size)
{
    struct rcl_serialized message = {.buffer = malloc((size_t)size), .length = (size_t)size};
    struct kept *kept = message.buffer ? keep(&message) : NULL;
    if (kept)
        memcpy(message.buffer, data, (size_t)size);
    else
        free(message.buffer);
    return kept;
}

static void leave_kept(struct kept *kept)
{
    if (!kept || __atomic_sub_fetch(&kept->owners, 1, __ATOMIC_ACQ_REL))
        return;
    free(kept->message.buffer);
    free(kept);
}

/* One output of a stream. */
struct output {
    uint8_t *template;           /* of bulk to OpenIGTLink: the bytes before the content */
    ssize_t size, at, digits_at; /* at: of the stamp (to ROS), of the numbers (to OpenIGTLink) */
    ssize_t id_at;               /* of metadata beside a pose to ROS: of the message id; 0: it is the pose */
    uint8_t *tail;               /* of bulk to OpenIGTLink: the bytes after the content */
    ssize_t tail_size;
    struct ros_form form;        /* of bulk to ROS */
    char keep;                   /* a full send queue must not drop it */
    uint64_t number;             /* of its stream in the recorder's queue */
    uint64_t sent;               /* messages */
    long long ignored;           /* messages that a link took no more; atomic */
    Publisher *publisher;
    Link *links[MAX_LINKS];
    int link_count;
    char *channel;
};

struct Stream {
    PyObject_HEAD
    Passage *passage;
    Stream *next;                /* of the same bucket */
    Link *link;                  /* to ROS: where it comes from */
    Subscription *subscription;  /* to OpenIGTLink: where it comes from */
    uint8_t names[NAMES_BYTES];
    uint8_t *sample;
    struct metadata metadata; /* to ROS */
    ssize_t at, place_at;
    struct igtl_poses from_igtl;
    struct ros_poses from_ros;
    int is_bulk; /* strings, points, clouds, pictures and tracking data: these instead of the two above */
    struct igtl_bulk bulk_from_igtl;
    struct ros_bulk bulk_from_ros;
    ssize_t places[MAX_PLACES];
    int own;
    struct output outputs[MAX_OUTPUTS];
    int output_count;
    uint64_t number;
    char is_stale; /* the recorder counts streams from the start again */
    Guard *guard; /* NULL: the stream is not guarded; several streams may share one */
    /* since the last collection */
    uint64_t received, converted, unheard;
    uint64_t latest_seq;
    int64_t latest_stamp_ns, latest_source_ns;
    uint8_t *latest;
    ssize_t latest_size;
    char keeps;         /* to ROS: the latest message is kept, too */
    unsigned waits;     /* of the latest message, see choose_outputs */
    struct kept *large; /* the latest message, if it is large */
    int is_in_use;      /* a thread passes a message on without the sequence lock and the GIL; atomic */
};

/* Note the latest message of a stream. */
static void set_latest(Stream *stream, uint64_t seq, int64_t stamp_ns, int64_t source_ns, struct kept *large)
{
    stream->latest_seq = seq;
    stream->latest_stamp_ns = stamp_ns;
    stream->latest_source_ns = source_ns;
    leave_kept(stream->large);
    if ((stream->large = large))
        __atomic_add_fetch(&large->owners, 1, __ATOMIC_RELAXED);
}

/* is_unit_jump of guarded_stream.py, without its precision: 1 where Python has to judge. */
static int might_jump(const double before[3], const double after[3])
{
    double one = before[0] * before[0] + before[1] * before[1] + before[2] * before[2];
    double other = after[0] * after[0] + after[1] * after[1] + after[2] * after[2];
    double least = one < other ? one : other, most = one < other ? other : one;
    return !(most <= LEAST_SUSPECT * LEAST_SUSPECT * least) && most > 0.0;
}

/* GuardedStream.passes_quickly: 1 where the message passes and is observed; 0, and nothing changes: Python judges.
 * A twin of guarded_stream.py, see ARCHITECTURE.md; tests/native/test_twins.py compares them. */
static int passes_guard(Guard *guard, int64_t now_ns, int64_t stamp_ns, const double place[3])
{
    if (!guard)
        return 1;
    if (guard->judged_by_python)
        return 0;
    if (stamp_ns < guard->last_ns)
        return 0;
    if (now_ns >= guard->look_ns) {
        if (guard->max_age_ns && ((stamp_ns == now_ns && !guard->knows_age) ||
                                  now_ns - guard->ahead_ns - stamp_ns > guard->max_age_ns))
            return 0;
        if (guard->watches && now_ns >= guard->due_ns) {
            int64_t still = stamp_ns == guard->seen_ns ? guard->still + 1 : 0;
            if (stamp_ns != now_ns && stamp_ns - now_ns + guard->ahead_ns > FUTURE_NS)
                return 0;
            if (still >= STILL_LOOKS || guard->observed == OBSERVATIONS || now_ns > guard->episode_ends_ns)
                return 0;
            if (place && guard->has_place && might_jump(guard->place, place))
                return 0;
            int64_t *observation = guard->observations[guard->observed++];
            observation[0] = stamp_ns != now_ns ? stamp_ns : 0;
            observation[1] = now_ns - guard->ahead_ns;
            guard->still = still;
            guard->seen_ns = stamp_ns;
            guard->has_place = place != NULL;
            if (place)
                memcpy(guard->place, place, sizeof guard->place);
            guard->arrived_ns = now_ns;
            guard->due_ns = now_ns + LOOK_NS;
            guard->look_ns = guard->max_age_ns ? 0 : guard->due_ns;
        }
    }
    guard->last_ns = stamp_ns;
    guard->is_dirty = 1;
    return 1;
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

static uint8_t *scratch_of(Passage *self, int output) { return self->scratch + (size_t)output * LARGEST_OUTPUT; }

static uint8_t *copied(const void *data, ssize_t size)
{
    uint8_t *copy = malloc(size ? size : 1);
    if (copy)
        memcpy(copy, data, size);
    return copy;
}

/* -- the recorder ----------------------------------------------------------------------------------------------------- */

/* Bytes that the next messages might need in the recorder's queue. */
static ssize_t room_ahead(const Passage *self)
{
    return ROOM_AHEAD + __atomic_load_n(&self->largest_recorded, __ATOMIC_RELAXED);
}

/* Have Python wake the recorder, or find room for the next messages, after one with which that is due. */
static void attend_recorder(Passage *self)
{
    if (!__atomic_exchange_n(&self->presses, 0, __ATOMIC_RELAXED))
        return;
    pthread_mutex_lock(&self->events);
    self->attends = 1;
    pthread_cond_signal(&self->pressed);
    pthread_mutex_unlock(&self->events);
}

/* Take the recorder's queue for entries of these streams; 0: Python has to put them. ``most``: bytes. */
static int begin_record(Passage *self, Stream *stream, struct output *const *outputs, int count, ssize_t bytes,
                        ssize_t most)
{
    if (!self->is_recorded)
        return 1;
    if (!lock_briefly(&self->queue_lock->mutex))
        return 0;
    int known = queue_knows(&self->queue, stream->number);
    for (int i = 0; i < count; i++)
        known &= queue_knows(&self->queue, outputs[i]->number);
    stream->is_stale |= !known;
    if (known && bytes <= most && queue_has_room(&self->queue, (uint64_t)count + 1, (uint64_t)bytes)) {
        if (bytes > self->largest_recorded)
            __atomic_store_n(&self->largest_recorded, bytes, __ATOMIC_RELAXED);
        if (queue_presses(&self->queue, (uint64_t)count + 1, (uint64_t)bytes) ||
            queue_left(&self->queue) < (uint64_t)(bytes + room_ahead(self)))
            __atomic_store_n(&self->presses, 1, __ATOMIC_RELAXED);
        return 1;
    }
    pthread_mutex_unlock(&self->queue_lock->mutex);
    return 0;
}

static void end_record(Passage *self)
{
    if (self->is_recorded)
        pthread_mutex_unlock(&self->queue_lock->mutex);
}

/* Give an input and its outputs, which are in the scratch memory, to the recorder; then its queue is free. */
static void record(Passage *self, const Stream *stream, struct output *const *outputs, const ssize_t *sizes, int count,
                   uint64_t seq, int64_t stamp_ns, int64_t source_ns, int64_t shown_ns, const uint8_t *data, ssize_t size)
{
    if (!self->is_recorded)
        return;
    queue_add(&self->queue, stream->number, seq, (uint64_t)stamp_ns, (uint64_t)source_ns, data, (uint64_t)size);
    for (int i = 0; i < count; i++)
        queue_add(&self->queue, outputs[i]->number, seq + 1 + i, (uint64_t)(stamp_ns + 1 + i), (uint64_t)shown_ns,
                  scratch_of(self, i), (uint64_t)sizes[i]);
    end_record(self);
}

/* Have places for the payloads of an input and its outputs in the recorder's queue, which is free then: they are to be
 * filled at once, without the locks. */
static void reserve(Passage *self, const Stream *stream, struct output *const *outputs, const ssize_t *sizes, int count,
                    uint64_t seq, int64_t stamp_ns, int64_t source_ns, int64_t shown_ns, ssize_t size, uint8_t **slots)
{
    if (!self->is_recorded)
        return;
    slots[0] = queue_reserve(&self->queue, stream->number, seq, (uint64_t)stamp_ns, (uint64_t)source_ns, (uint64_t)size);
    for (int i = 0; i < count; i++)
        slots[1 + i] = queue_reserve(&self->queue, outputs[i]->number, seq + 1 + i, (uint64_t)(stamp_ns + 1 + i),
                                     (uint64_t)shown_ns, (uint64_t)sizes[i]);
    end_record(self);
}

/* Copy the parts, one after the other, to ``to``. */
static void join_parts(uint8_t *to, const struct iovec *parts, int count)
{
    for (int i = 0; i < count; to += parts[i++].iov_len)
        memcpy(to, parts[i].iov_base, parts[i].iov_len);
}

/* Fill a place in the recorder's queue, if there is one. */
static void fill(uint8_t *slot, const struct iovec *parts, int count)
{
    if (!slot)
        return;
    join_parts(slot, parts, count);
    queue_filled(slot);
}

/* A large message that has passed, and has places in the recorder's queue: it is copied there when its receiver has
 * probably read it. */
struct unfilled {
    struct unfilled *next;
    int direction, count;       /* of the entries: the input and its outputs */
    int64_t passed_ns, due_ns;  /* monotonic */
    uint8_t *slots[1 + MAX_OUTPUTS];
    struct iovec parts[1 + MAX_OUTPUTS][MAX_PARTS];
    int parts_counts[1 + MAX_OUTPUTS];
    struct kept *kept; /* what the parts are of: this and */
    uint8_t *made;
};

static void add_entry(struct unfilled *unfilled, uint8_t *slot, const struct iovec *parts, int count)
{
    memcpy(unfilled->parts[unfilled->count], parts, (size_t)count * sizeof *parts);
    unfilled->parts_counts[unfilled->count] = count;
    unfilled->slots[unfilled->count++] = slot;
}

/* Copy a message to its places in the recorder's queue, if it has any, and forget it. */
static void end_unfilled(Passage *self, struct unfilled *unfilled)
{
    for (int i = 0; i < unfilled->count; i++)
        fill(unfilled->slots[i], unfilled->parts[i], unfilled->parts_counts[i]);
    count_recording(self, unfilled->direction, unfilled->passed_ns);
    attend_recorder(self);
    leave_kept(unfilled->kept);
    free(unfilled->made);
    free(unfilled);
}

/* Take the oldest of a direction that has waited until this time (monotonic); NULL: none has.  With the lock of events. */
static struct unfilled *take_unfilled(Passage *self, int direction, int64_t until_ns)
{
    struct unfilled *oldest = self->unfilled[direction];
    if (!oldest || (oldest->due_ns > until_ns && self->unfilled_count[direction] <= MAX_UNFILLED))
        return NULL;
    if (!(self->unfilled[direction] = oldest->next))
        self->unfilled_end[direction] = &self->unfilled[direction];
    self->unfilled_count[direction]--;
    return oldest;
}

/* Copy all of a direction that have waited until this time. */
static void fill_until(Passage *self, int direction, int64_t until_ns)
{
    for (;;) {
        pthread_mutex_lock(&self->events);
        struct unfilled *unfilled = take_unfilled(self, direction, until_ns);
        pthread_mutex_unlock(&self->events);
        if (!unfilled)
            return;
        end_unfilled(self, unfilled);
    }
}

/* Copy a message that has just passed to the recorder's queue, when ``bytes`` of it are read.  Owns ``made`` from here on,
 * and takes part in ``kept``. */
static void fill_later(Passage *self, struct unfilled *unfilled, struct kept *kept, uint8_t *made, ssize_t bytes)
{
    int direction = unfilled->direction;
    unfilled->due_ns = unfilled->passed_ns + (int64_t)bytes * 1000 / READ_BYTES_PER_US;
    unfilled->kept = kept, unfilled->made = made;
    __atomic_add_fetch(&kept->owners, 1, __ATOMIC_RELAXED);
    if (!self->is_recorded) {
        end_unfilled(self, unfilled);
        return;
    }
    pthread_mutex_lock(&self->events);
    *self->unfilled_end[direction] = unfilled;
    self->unfilled_end[direction] = &unfilled->next;
    self->unfilled_count[direction]++;
    pthread_mutex_unlock(&self->events);
    fill_until(self, direction, unfilled->passed_ns);
}

/* Wait for a condition, and copy meanwhile what is due.  With the lock of events. */
static void wait_and_fill(Passage *self, pthread_cond_t *condition, int direction)
{
    const struct unfilled *oldest = self->unfilled[direction];
    if (!oldest) {
        pthread_cond_wait(condition, &self->events);
        return;
    }
    int64_t due_ns = oldest->due_ns;
    const struct timespec until = {.tv_sec = due_ns / NS_PER_S, .tv_nsec = due_ns % NS_PER_S};
    if (pthread_cond_timedwait(condition, &self->events, &until) != ETIMEDOUT)
        return;
    pthread_mutex_unlock(&self->events);
    fill_until(self, direction, due_ns);
    pthread_mutex_lock(&self->events);
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

/* -- OpenIGTLink to ROS ------------------------------------------------------------------------------------------------ */

static int has_subscriber(Passage *self, Publisher *publisher)
{
    size_t subscribers = 0;
    return self->subscribers(publisher->pointer, &subscribers) == RCL_RET_OK && subscribers > 0;
}

static void publish(Passage *self, Publisher *publisher, uint8_t *cdr, ssize_t size)
{
    struct rcl_serialized message = {.buffer = cdr, .length = (size_t)size, .capacity = (size_t)size};
    struct own_message *own = NULL;
    if (publisher->latched) {
        pthread_mutex_lock(&publisher->publishing);
        own = &publisher->own_messages[publisher->begun++ % REMEMBERED];
        own->whole = size, own->size = size < REMEMBERED_BYTES ? size : REMEMBERED_BYTES;
        memcpy(own->bytes, cdr, (size_t)own->size);
        own->begun_ns = clock_ns(CLOCK_REALTIME);
    }
    if (self->publish(publisher->pointer, &message, NULL) == RCL_RET_OK)
        add(&publisher->published);
    else
        add(&publisher->failed);
    if (own) {
        own->ended_ns = clock_ns(CLOCK_REALTIME);
        pthread_mutex_unlock(&publisher->publishing);
    }
}

/* The outputs of a message, of which a row of the table may have none, and those without a subscriber are left out. */
struct chosen {
    struct output *outputs[MAX_OUTPUTS];
    struct ros_form forms[MAX_OUTPUTS]; /* of bulk */
    ssize_t sizes[MAX_OUTPUTS], bytes;  /* bytes: of all */
    int heard[MAX_OUTPUTS], count, wanted;
    unsigned waits; /* bits of outputs of which Python keeps the latest message for their first subscriber */
};

/* Choose the outputs of a message, each of at most ``most`` bytes; 0: it must go to Python. */
static int choose_outputs(Passage *self, Stream *stream, const uint8_t *data, ssize_t size, ssize_t most,
                          struct chosen *chosen)
{
    const struct igtl_bulk *bulk = &stream->bulk_from_igtl;
    chosen->count = chosen->wanted = 0, chosen->bytes = 0, chosen->waits = 0;
    for (int i = 0; i < stream->output_count; i++) {
        struct output *output = &stream->outputs[i];
        int count = chosen->count;
        struct ros_form *form = &chosen->forms[count];
        if (stream->is_bulk) {
            *form = output->form;
            if (!prepare_form(form, data + bulk->at, size - bulk->at - bulk->tail) || form->size > most)
                return 0;
        }
        chosen->sizes[count] = stream->is_bulk ? form->size : output->size; /* 0: the row does not apply */
        if (output->publisher->by_python) {
            if (!chosen->sizes[count])
                continue;
            stream->is_stale = 1; /* there might be another publisher now */
            return 0;
        }
        int hears = output->publisher->pointer && has_subscriber(self, output->publisher);
        if (output->publisher->latched && !hears && !self->builds_all) {
            if (!stream->keeps)
                return 0; /* Python keeps it for the first subscriber */
            chosen->waits |= 1u << i;
        }
        if (!hears && !self->builds_all)
            continue;
        chosen->wanted++;
        if (!chosen->sizes[count])
            continue;
        chosen->heard[count] = hears || output->publisher->latched;
        chosen->bytes += chosen->sizes[count];
        chosen->outputs[chosen->count++] = output;
    }
    return 1;
}

/* Publish an output, or count that it has no subscriber. */
static void publish_output(Passage *self, const struct chosen *chosen, int i, uint8_t *cdr)
{
    Publisher *publisher = chosen->outputs[i]->publisher;
    if (chosen->heard[i])
        publish(self, publisher, cdr, chosen->sizes[i]);
    else if (publisher->pointer)
        add(&publisher->unheard);
}

static void count_to_ros(Passage *self, Stream *stream, const struct chosen *chosen)
{
    for (int i = 0; i < chosen->count; i++)
        chosen->outputs[i]->sent++;
    stream->received++;
    if (chosen->count || self->builds_all)
        stream->converted++;
    else
        stream->unheard++;
}

/* Pass a whole message on; 0, and nothing has happened: it must go to Python.  The caller has the sequence lock. */
static int pass_to_ros(Passage *self, Stream *stream, const uint8_t *data, ssize_t size, int64_t begun_ns)
{
    int64_t stamp_ns, now_ns = time_of_input(self, &stamp_ns), locked_ns = clock_ns(CLOCK_MONOTONIC);
    double pose[7], place[3];
    int is_bulk = stream->is_bulk;
    if (!now_ns || (is_bulk ? size > LARGEST_RECEIVED || !bulk_from_igtl_fits(&stream->bulk_from_igtl, data, size)
                            : !pose_from_igtl(&stream->from_igtl, data, size, pose)))
        return 0;
    int64_t source_ns = ticks_to_ns(get_u64(data + TICKS_AT));
    int64_t shown_ns = stream->own && source_ns > 0 ? source_ns : stamp_ns;
    struct chosen chosen;
    if (!choose_outputs(self, stream, data, size, LARGEST_OUTPUT, &chosen))
        return 0;
    int count = chosen.count;
    for (int i = 0; i < count; i++)
        chosen.forms[i].out = scratch_of(self, i);
    if (is_bulk && (!chosen.wanted || !bulk_from_igtl(&stream->bulk_from_igtl, data, size, chosen.forms, count, shown_ns)))
        return 0; /* without a subscriber, only the full path checks it */
    for (int i = 0; i < 3 && !is_bulk; i++)
        place[i] = get_f32(data + stream->place_at + 4 * i);
    struct kept *kept = stream->keeps ? keep_copy(data, size) : NULL;
    if ((stream->keeps && !kept) ||
        !begin_record(self, stream, chosen.outputs, count, size + chosen.bytes, LARGEST_RECORDED)) {
        leave_kept(kept);
        return 0;
    }
    if (!passes_guard(stream->guard, stamp_ns, shown_ns, is_bulk ? NULL : place)) {
        end_record(self);
        leave_kept(kept);
        return 0;
    }
    uint64_t seq = take_numbers(self, count, now_ns, stamp_ns);
    if (kept) {
        set_latest(stream, seq, stamp_ns, source_ns, kept);
        stream->waits = chosen.waits;
        leave_kept(kept);
    }
    int64_t converted_ns = clock_ns(CLOCK_MONOTONIC);
    for (int i = 0; i < count; i++) {
        struct output *output = chosen.outputs[i];
        uint8_t *cdr = scratch_of(self, i);
        if (!is_bulk) {
            memcpy(cdr, output->template, output->size);
            put_ros_pose_or_id(cdr, output->size, output->at, output->id_at, shown_ns, pose, data);
        }
        publish_output(self, &chosen, i, cdr);
    }
    int64_t passed_ns = clock_ns(CLOCK_MONOTONIC);
    record(self, stream, chosen.outputs, chosen.sizes, count, seq, stamp_ns, source_ns, shown_ns, data, size);
    count_times(self, TO_ROS, locked_ns - begun_ns, converted_ns - locked_ns, passed_ns - converted_ns);
    count_recording(self, TO_ROS, passed_ns);
    count_to_ros(self, stream, &chosen);
    attend_recorder(self);
    return 1;
}

/* -- links ---------------------------------------------------------------------------------------------------------------- */

enum { NATIVE, PYTHON }; /* who reads a link */

/* A message of which the kernel took nothing, or only the beginning: Python queues it, unless the thread that has its memory
 * sends it in time. */
struct unsent {
    uint8_t *data;
    const struct iovec *parts; /* of the message, in the memory of that thread; NULL: it is in ``data`` */
    int parts_count;
    ssize_t size, sent;
    char *channel;
    char keep;
    struct unsent *next;
};

/* A large message that was read whole, for Python. */
struct large {
    struct rcl_serialized message; /* only its memory */
    char is_checked;               /* its CRC is right */
    struct large *next;
};

struct Link {
    PyObject_HEAD
    Passage *passage;
    int fd, number;
    Stream *streams[BUCKETS]; /* owns a reference to each */
    int stream_count;
    /* reading; guarded by `reading` */
    pthread_mutex_t reading;
    int reader;
    int failure; /* errno of the last reading; 0: none, or the peer has ended */
    uint8_t *chunk;
    ssize_t start, filled; /* of what was received and not passed on */
    uint8_t *body; /* a large message that is being read; NULL: the chunk is filled */
    ssize_t body_size, body_filled;
    char checks;       /* its CRC is taken while it is read, and still in the cache */
    uint64_t body_crc; /* of what is read */
    struct {
        uint8_t names[NAMES_BYTES];
        ssize_t most; /* bytes of a message */
    } large_streams[MAX_LARGE_STREAMS]; /* guarded by the sequence lock */
    int large_stream_count;
    struct large *large, **large_end; /* guarded by the passage's events */
    int large_waiting;                /* read, and not handled by Python yet; atomic */
    int is_paused;                    /* too many of them; atomic */
    double room; /* messages that may arrive at once */
    double rate; /* by which it grows, per second, up to that of one second */
    int64_t rated_ns;
    char is_limited; /* there is no room: TCP makes the peer wait */
    int64_t pauses_noted_ns;
    long long pauses; /* that Python has not taken over */
    long long received_messages, received_bytes, heard_ns;
    /* sending; guarded by the lock of the sender */
    Lock *sending;
    _Atomic char clear; /* nothing is queued: what is sent goes to the kernel at once */
    char muted;         /* nothing is sent any more */
    struct unsent *unsent, **unsent_end; /* oldest first; then the link is not clear */
    struct unsent *lent; /* the one that is in the memory of another thread; that one is the oldest */
    long long unsent_bytes, lent_bytes; /* the latter: how many of the former are of the lent one */
    long long sent_messages, sent_bytes;
    /* events; guarded by the passage */
    Link *next_noted, *next_closed, *next_with_large;
    char is_noted, is_closed, is_with_large;
    /* turns, as in turns.py; of the reading thread alone */
    Link *next_waiting;
    int64_t turn_ns;
    char waits;
    /* pauses; likewise */
    Link *next_limited;
    int64_t pause_ends_ns;
    char is_listed; /* it is in the list */
};

static unsigned bucket_of(const uint8_t *names)
{
    uint32_t hash = 2166136261u;
    for (int i = 0; i < NAMES_BYTES; i++)
        hash = (hash ^ names[i]) * 16777619u;
    return (hash ^ hash >> 16) % BUCKETS;
}

/* One of the streams of these names; they differ in their metadata. */
static Stream *stream_named(Stream *stream, const uint8_t *names)
{
    while (stream && memcmp(stream->names, names, NAMES_BYTES))
        stream = stream->next;
    return stream;
}

/* The stream of a whole message. */
static Stream *stream_of(Link *self, const uint8_t *message, ssize_t size)
{
    Stream *stream = stream_named(self->streams[bucket_of(message)], message);
    while (stream && !has_metadata(&stream->metadata, message, size))
        stream = stream_named(stream->next, message);
    return stream;
}

static int has_stream(Link *self, const Stream *stream)
{
    const Stream *one = self->streams[bucket_of(stream->names)];
    while (one && one != stream)
        one = one->next;
    return one != NULL;
}

static void wake_links(Passage *passage)
{
    uint64_t one = 1;
    if (write(passage->wake, &one, sizeof one) < 0)
        return; /* it is awake already */
}

/* Have Python look at a link. */
static void note_link(Link *self)
{
    Passage *passage = self->passage;
    pthread_mutex_lock(&passage->events);
    if (!self->is_noted) {
        self->is_noted = 1;
        self->next_noted = passage->noted;
        passage->noted = self;
    }
    pthread_mutex_unlock(&passage->events);
    wake_links(passage);
}

/* Give the link to Python, with what is left in the chunk; the caller has `reading`. */
static void give_to_python(Link *self, int failure)
{
    self->failure = failure;
    self->reader = PYTHON;
    epoll_ctl(self->passage->epoll, EPOLL_CTL_DEL, self->fd, NULL);
    note_link(self);
}

/* The most bytes of a large message with these names; 0: Python reads it. */
static ssize_t most_of_large(const Link *self, const uint8_t *names)
{
    for (int i = 0; i < self->large_stream_count; i++)
        if (!memcmp(self->large_streams[i].names, names, NAMES_BYTES))
            return self->large_streams[i].most;
    return 0;
}

/* A large message that was read whole has passed; the caller has `reading`. */
static int end_body(Link *self)
{
    self->body = NULL;
    self->received_messages++;
    self->room--;
    return 1;
}

/* Pass on a large message that was read whole, if it takes no longer than others may wait; the caller has `reading`. */
static int pass_body(Link *self)
{
    wait_for_sequence(self->passage);
    Stream *stream = __atomic_load_n(&self->large_waiting, __ATOMIC_ACQUIRE) ? NULL : stream_of(self, self->body, self->body_size); /* perhaps for one of its stream */
    int passed = stream && pass_to_ros(self->passage, stream, self->body, self->body_size, self->heard_ns);
    unlock_sequence(self->passage);
    if (!passed)
        return 0;
    free(self->body);
    return end_body(self);
}

/* Give a large message, whose outputs are made, its number and its places in the recorder's queue; 0: Python's.
 * ``data``: at least its header.  The caller has the sequence lock. */
static int admit_to_ros(Link *self, Stream *stream, const uint8_t *data, const struct chosen *chosen, struct kept *kept,
                        int64_t *shown_ns, uint8_t **slots)
{
    Passage *passage = self->passage;
    ssize_t size = (ssize_t)kept->message.length;
    int64_t stamp_ns = 0, now_ns = time_of_input(passage, &stamp_ns), source_ns = ticks_to_ns(get_u64(data + TICKS_AT));
    if (!now_ns || !has_stream(self, stream))
        return 0;
    for (int i = 0; i < chosen->count; i++)
        if (chosen->outputs[i]->publisher->by_python)
            return 0;
    *shown_ns = stream->own && source_ns > 0 ? source_ns : stamp_ns;
    if (!begin_record(passage, stream, chosen->outputs, chosen->count, size + chosen->bytes, size + chosen->bytes))
        return 0;
    if (!passes_guard(stream->guard, stamp_ns, *shown_ns, NULL)) {
        end_record(passage);
        return 0;
    }
    uint64_t seq = take_numbers(passage, chosen->count, now_ns, stamp_ns);
    reserve(passage, stream, chosen->outputs, chosen->sizes, chosen->count, seq, stamp_ns, source_ns, *shown_ns, size, slots);
    count_to_ros(passage, stream, chosen);
    if (stream->keeps) {
        set_latest(stream, seq, stamp_ns, source_ns, kept);
        stream->waits = chosen->waits;
    }
    return 1;
}

/* Pass a large message on without the sequence lock, except for its number; 0, and nothing has happened: it must go to
 * Python.  ``most``: bytes of its outputs.  The stream stays until the end: the caller owns a reference, or has it in use. */
static int pass_large_to_ros(Link *self, Stream *stream, struct kept *kept, int is_checked, ssize_t most)
{
    Passage *passage = self->passage;
    uint8_t *data = kept->message.buffer;
    ssize_t size = (ssize_t)kept->message.length;
    struct igtl_bulk bulk = stream->bulk_from_igtl;
    int64_t begun_ns = clock_ns(CLOCK_MONOTONIC), shown_ns;
    struct chosen chosen;
    if (!stream->is_bulk || !bulk_from_igtl_fits(&stream->bulk_from_igtl, data, size) ||
        !choose_outputs(passage, stream, data, size, most, &chosen) || !chosen.wanted || chosen.bytes > most)
        return 0;
    bulk.check_crc &= !is_checked;
    /* The pixels of a picture stay where they are: what was before them is kept apart. */
    int stays = chosen.count == 1 && chosen.forms->form == PICTURE && chosen.forms->room <= bulk.at && !bulk.check_crc;
    uint8_t *made = malloc(stays ? (size_t)bulk.at : (size_t)chosen.bytes + 1), *end = made, *slots[1 + MAX_OUTPUTS] = {NULL};
    for (int i = 0; made && i < chosen.count; end += chosen.sizes[i++])
        chosen.forms[i].out = stays ? data + bulk.at - chosen.forms->room : end;
    if (made && stays) {
        memcpy(made, data, (size_t)bulk.at);
        put_frame(chosen.forms, size - bulk.at - bulk.tail, 0);
    }
    struct unfilled *unfilled = calloc(1, sizeof *unfilled);
    int passes = made && unfilled && (stays || bulk_from_igtl(&bulk, data, size, chosen.forms, chosen.count, 0));
    int64_t converted_ns = clock_ns(CLOCK_MONOTONIC), locked_ns = converted_ns;
    if (passes) {
        wait_for_sequence(passage);
        locked_ns = clock_ns(CLOCK_MONOTONIC);
        passes = admit_to_ros(self, stream, stays ? made : data, &chosen, kept, &shown_ns, slots);
        unlock_sequence(passage);
    }
    if (passes) {
        for (int i = 0; i < chosen.count; i++) {
            put_stamps(&chosen.forms[i], shown_ns);
            publish_output(passage, &chosen, i, chosen.forms[i].out);
        }
        *unfilled = (struct unfilled){.direction = TO_ROS, .passed_ns = clock_ns(CLOCK_MONOTONIC)};
        const struct iovec input[2] = {{stays ? made : data, (size_t)bulk.at}, {data + bulk.at, (size_t)(size - bulk.at)}};
        add_entry(unfilled, slots[0], input, 2);
        for (int i = 0; i < chosen.count; i++) {
            const struct iovec output = {chosen.forms[i].out, (size_t)chosen.sizes[i]};
            add_entry(unfilled, slots[1 + i], &output, 1);
        }
        count_times(passage, TO_ROS, locked_ns - converted_ns, converted_ns - begun_ns, unfilled->passed_ns - locked_ns);
        fill_later(passage, unfilled, kept, made, chosen.bytes);
        return 1;
    }
    if (made && stays)
        memcpy(data, made, (size_t)bulk.at);
    free(unfilled);
    free(made);
    return 0;
}

static int is_right(const Link *self) { return self->checks && self->body_crc == get_u64(self->body + CRC_AT); }

/* Pass on a message that is larger than its outputs, such as points, without the way to the other thread.  What is
 * recorded is copied whole: others would wait for that.  The caller has `reading`. */
static int pass_points(Link *self)
{
    Passage *passage = self->passage;
    struct rcl_serialized message = {.buffer = self->body, .length = (size_t)self->body_size};
    wait_for_sequence(passage);
    int waits = passage->is_recorded || __atomic_load_n(&self->large_waiting, __ATOMIC_ACQUIRE);
    Stream *stream = waits ? NULL : stream_of(self, self->body, self->body_size);
    if (stream)
        __atomic_store_n(&stream->is_in_use, 1, __ATOMIC_RELEASE);
    unlock_sequence(passage);
    struct kept *kept = stream ? keep(&message) : NULL;
    int passed = kept && pass_large_to_ros(self, stream, kept, is_right(self), LARGEST_RECEIVED);
    if (stream)
        __atomic_store_n(&stream->is_in_use, 0, __ATOMIC_RELEASE);
    if (!passed) {
        free(kept);
        return 0;
    }
    leave_kept(kept);
    return end_body(self);
}

/* Leave a large message that was read whole to Python, and go on reading; the caller has `reading`. */
static void end_large(Link *self)
{
    struct large *large = calloc(1, sizeof *large);
    Passage *passage = self->passage;
    if (!large) { /* Python reads it from the beginning */
        give_to_python(self, 0);
        return;
    }
    large->message.buffer = self->body;
    large->message.length = large->message.capacity = (size_t)self->body_size;
    large->is_checked = is_right(self);
    end_body(self);
    pthread_mutex_lock(&passage->events);
    *self->large_end = large;
    self->large_end = &large->next;
    passage->large_bytes += (long long)large->message.length;
    int is_much = passage->large_bytes > MOST_LARGE_BYTES;
    int waiting = __atomic_add_fetch(&self->large_waiting, 1, __ATOMIC_SEQ_CST);
    if (!self->is_with_large) {
        self->is_with_large = 1;
        self->next_with_large = passage->with_large;
        passage->with_large = self;
        pthread_cond_signal(&passage->large_read);
    }
    pthread_mutex_unlock(&passage->events);
    if (waiting >= (is_much ? 1 : MAX_LARGE_WAITING)) {
        epoll_ctl(passage->epoll, EPOLL_CTL_DEL, self->fd, NULL);
        __atomic_store_n(&self->is_paused, 1, __ATOMIC_SEQ_CST);
    }
}

/* Begin to read a large message, whose beginning is in the chunk; 0: Python has to read it. */
static int begin_large(Link *self, uint64_t total)
{
    wait_for_sequence(self->passage);
    ssize_t most = most_of_large(self, self->chunk + self->start);
    const uint8_t *names = self->chunk + self->start;
    Stream *stream = total > LARGEST_RECEIVED ? stream_named(self->streams[bucket_of(names)], names) : NULL;
    self->checks = stream && stream->is_bulk && stream->bulk_from_igtl.check_crc;
    unlock_sequence(self->passage);
    if (total > (uint64_t)most || !(self->body = malloc(total)))
        return 0;
    self->body_size = (ssize_t)total;
    self->body_filled = self->filled - self->start;
    memcpy(self->body, self->chunk + self->start, self->body_filled);
    self->body_crc = self->checks ? crc64_update(0, self->body + HEADER_SIZE, self->body_filled - HEADER_SIZE) : 0;
    self->start = self->filled = 0;
    return 1;
}

/* Whether what was received is a whole small message, or the beginning of a large one: something to be passed on. */
static int has_message(const Link *self)
{
    ssize_t left = self->filled - self->start;
    if (left < HEADER_SIZE)
        return 0;
    uint64_t body = get_u64(self->chunk + self->start + BODY_SIZE_AT);
    return body > CHUNK_BYTES - HEADER_SIZE || left >= HEADER_SIZE + (ssize_t)body;
}

/* Let the room grow until now. */
static void make_room(Link *self, int64_t now_ns)
{
    self->room += (now_ns - self->rated_ns) * self->rate / NS_PER_S;
    if (self->room > self->rate)
        self->room = self->rate;
    self->rated_ns = now_ns;
}

/* Receive once; 0: there is nothing to be passed on.  The caller has `reading`. */
static int receive(Link *self)
{
    if (self->start) {
        self->filled -= self->start;
        memmove(self->chunk, self->chunk + self->start, self->filled);
        self->start = 0;
    }
    uint8_t *place = self->body ? self->body + self->body_filled : self->chunk + self->filled;
    ssize_t room = self->body ? self->body_size - self->body_filled : CHUNK_BYTES - self->filled;
    ssize_t count = recv(self->fd, place, room < LARGEST_RECEIPT ? room : LARGEST_RECEIPT, MSG_DONTWAIT);
    if (count < 0 && (errno == EAGAIN || errno == EINTR))
        return 0;
    if (count <= 0) {
        give_to_python(self, count ? errno : 0);
        return 0;
    }
    self->heard_ns = clock_ns(CLOCK_MONOTONIC);
    self->received_bytes += count;
    make_room(self, self->heard_ns);
    if (!self->body) {
        self->filled += count;
        return has_message(self);
    }
    self->body_filled += count;
    if (self->checks)
        self->body_crc = crc64_update(self->body_crc, place, count);
    int is_whole = self->body_filled == self->body_size;
    if (is_whole && !(self->body_size > LARGEST_RECEIVED ? pass_points(self) : pass_body(self)))
        end_large(self);
    return 0;
}

/* Read on when there is room again: what the peer sends waits in its connection.  The caller has `reading`. */
static void limit_rate(Link *self, int64_t now_ns)
{
    Passage *passage = self->passage;
    int64_t pause_ns = self->rate > 0 ? (int64_t)((1 - self->room) / self->rate * NS_PER_S) : NS_PER_S;
    self->pause_ends_ns = now_ns + (pause_ns > PAUSE_NS ? pause_ns : PAUSE_NS);
    self->is_limited = 1;
    epoll_ctl(passage->epoll, EPOLL_CTL_DEL, self->fd, NULL);
    if (!self->is_listed) {
        self->is_listed = 1;
        self->next_limited = passage->limited;
        passage->limited = self;
    }
    add(&self->pauses);
    if (!self->pauses_noted_ns || now_ns - self->pauses_noted_ns >= NOTED_EVERY_NS) {
        self->pauses_noted_ns = now_ns;
        note_link(self);
    }
}

/* Take a turn: pass on what is whole, or receive once before; whether more is left for the next turn. */
static int read_link(Link *self, int64_t begun_ns)
{
    Passage *passage = self->passage;
    int64_t now_ns = begun_ns;
    int left = 0;
    pthread_mutex_lock(&self->reading);
    if (self->reader != NATIVE || self->is_paused || self->is_limited)
        goto done;
    make_room(self, begun_ns);
    left = has_message(self) || receive(self);
    while (left && now_ns - begun_ns < QUANTUM_NS) {
        if (self->room < 1) {
            limit_rate(self, now_ns);
            left = 0;
            break;
        }
        const uint8_t *message = self->chunk + self->start;
        uint64_t body = get_u64(message + BODY_SIZE_AT);
        int passed = 0;
        if (body <= CHUNK_BYTES - HEADER_SIZE) {
            wait_for_sequence(passage);
            Stream *stream = stream_of(self, message, HEADER_SIZE + (ssize_t)body);
            int waits = __atomic_load_n(&self->large_waiting, __ATOMIC_ACQUIRE) && most_of_large(self, message); /* for one of its stream */
            passed = stream && !waits && pass_to_ros(passage, stream, message, HEADER_SIZE + (ssize_t)body, now_ns);
            unlock_sequence(passage);
        } else if (begin_large(self, HEADER_SIZE + body)) {
            left = 0;
            break;
        }
        if (!passed) {
            give_to_python(self, 0);
            left = 0;
            break;
        }
        self->received_messages++;
        self->room--;
        self->start += HEADER_SIZE + (ssize_t)body;
        left = has_message(self);
        now_ns = clock_ns(CLOCK_MONOTONIC);
    }
done:
    pthread_mutex_unlock(&self->reading);
    return left;
}

/* Have a turn; of the reading thread alone, as the two that follow. */
static void ask_for_turn(Passage *passage, Link *self)
{
    if (self->waits)
        return;
    self->waits = 1;
    if (self->turn_ns < passage->turn_ns)
        self->turn_ns = passage->turn_ns;
    self->next_waiting = NULL;
    Link **at = &passage->waiting; /* behind those that are not later */
    while (*at && (*at)->turn_ns <= self->turn_ns)
        at = &(*at)->next_waiting;
    self->next_waiting = *at;
    *at = self;
}

static void leave_turns(Passage *passage, Link *self)
{
    for (Link **at = &passage->limited; *at; at = &(*at)->next_limited)
        if (*at == self) {
            *at = self->next_limited;
            break;
        }
    self->is_listed = 0;
    for (Link **at = &passage->waiting; *at; at = &(*at)->next_waiting)
        if (*at == self) {
            *at = self->next_waiting;
            break;
        }
    self->waits = 0;
}

/* Let links whose pause is over have their turns; return the time (ms) until the next pause ends, -1: there is none. */
static int end_pauses(Passage *passage)
{
    int64_t now_ns = passage->limited ? clock_ns(CLOCK_MONOTONIC) : 0, least_ns = -1;
    for (Link **at = &passage->limited; *at;) {
        Link *link = *at;
        int64_t left_ns = link->pause_ends_ns - now_ns;
        if (left_ns > 0) {
            if (least_ns < 0 || left_ns < least_ns)
                least_ns = left_ns;
            at = &link->next_limited;
            continue;
        }
        *at = link->next_limited;
        link->is_listed = 0;
        pthread_mutex_lock(&link->reading);
        int reads_on = link->is_limited && link->reader == NATIVE;
        if (reads_on) { /* else Python has it, or had it meanwhile */
            struct epoll_event event = {.events = EPOLLIN, .data.ptr = link};
            link->is_limited = 0;
            epoll_ctl(passage->epoll, EPOLL_CTL_ADD, link->fd, &event);
        }
        pthread_mutex_unlock(&link->reading);
        if (reads_on)
            ask_for_turn(passage, link);
    }
    return least_ns < 0 ? -1 : (int)(least_ns / 1000000 + 1);
}

/* Let the link have its turn that has used the least time. */
static void take_turn(Passage *passage)
{
    Link *link = passage->waiting;
    if (!link)
        return;
    passage->waiting = link->next_waiting;
    passage->turn_ns = link->turn_ns;
    link->waits = 0;
    int more = read_link(link, clock_ns(CLOCK_MONOTONIC));
    int64_t before_ns = passage->used_ns;
    passage->used_ns = clock_ns(CLOCK_THREAD_CPUTIME_ID);
    link->turn_ns += (passage->used_ns - before_ns) / (more || link->body ? 1 : PART);
    if (more)
        ask_for_turn(passage, link);
}

static void unlock_links(Stream *stream, int outputs, int links)
{
    for (int i = 0; i <= outputs && i < stream->output_count; i++) {
        struct output *output = &stream->outputs[i];
        for (int k = 0; k < (i < outputs ? output->link_count : links); k++)
            pthread_mutex_unlock(&output->links[k]->sending->mutex);
    }
}

/* Lock all links of a stream for sending; 0: one of them takes nothing now.  No link is in two outputs. */
static int lock_links(Stream *stream)
{
    for (int i = 0; i < stream->output_count; i++) {
        struct output *output = &stream->outputs[i];
        for (int k = 0; k < output->link_count; k++) {
            Link *link = output->links[k];
            if (!lock_briefly(&link->sending->mutex)) {
                unlock_links(stream, i, k);
                return 0;
            }
            if (!link->muted && link->unsent_bytes - link->lent_bytes > MOST_UNSENT) {
                unlock_links(stream, i, k + 1);
                return 0;
            }
        }
    }
    return 1;
}

/* Free the oldest message that was not sent. */
static void forget_unsent(Link *self)
{
    struct unsent *unsent = self->unsent;
    if (!(self->unsent = unsent->next))
        self->unsent_end = &self->unsent;
    self->unsent_bytes -= unsent->size;
    if (unsent == self->lent)
        self->lent = NULL, self->lent_bytes = 0;
    free(unsent->data);
    free(unsent->channel);
    free(unsent);
}

/* Have the kernel take as much of a message as it has room for, behind the first ``sent`` bytes; return how much, or -1. */
static ssize_t send_behind(const Link *self, const struct iovec *parts, int count, ssize_t sent)
{
    struct iovec left[MAX_PARTS];
    int number = 0;
    for (int i = 0; i < count; i++) {
        ssize_t size = (ssize_t)parts[i].iov_len, skipped = sent < size ? sent : size;
        sent -= skipped;
        if (skipped < size)
            left[number++] = (struct iovec){(uint8_t *)parts[i].iov_base + skipped, (size_t)(size - skipped)};
    }
    const struct msghdr message = {.msg_iov = left, .msg_iovlen = (size_t)number};
    return sendmsg(self->fd, &message, MSG_DONTWAIT | MSG_NOSIGNAL);
}

/* Send a message, of which the kernel takes at once what it has room for.  Returns what is queued of the rest, with a copy of
 * it if ``lends`` is 0; NULL: nothing.  A link that takes nothing any more, because its peer has left, is passed over.
 * The caller has the lock of the link. */
static struct unsent *send_or_queue(Link *self, const struct iovec *parts, int count, ssize_t size, struct output *output,
                                    int lends)
{
    if (self->muted) {
        add(&output->ignored);
        return NULL;
    }
    ssize_t sent = !self->clear ? 0 : count > 1 ? send_behind(self, parts, count, 0)
                                                : send(self->fd, parts->iov_base, (size_t)size, MSG_DONTWAIT | MSG_NOSIGNAL);
    if (sent == size) {
        self->sent_messages++;
        self->sent_bytes += size;
        return NULL;
    }
    struct unsent *unsent = calloc(1, sizeof *unsent);
    lends = lends && self->clear && sent > 0;
    uint8_t *data = lends ? NULL : malloc((size_t)size);
    self->clear = 0;
    if (!unsent) {
        free(data);
        return NULL;
    }
    if (data)
        join_parts(data, parts, count);
    *unsent = (struct unsent){.data = data, .parts = lends ? parts : NULL, .parts_count = count, .size = size,
                              .sent = sent > 0 ? sent : 0, .channel = strdup(output->channel), .keep = output->keep};
    *self->unsent_end = unsent;
    self->unsent_end = &unsent->next;
    self->unsent_bytes += size;
    if (lends)
        self->lent = unsent, self->lent_bytes = size;
    return unsent;
}

/* Send a message; what the kernel does not take is Python's, so that a link that is read slowly leaves the others native.
 * The caller has the lock of the link. */
static void send_to_link(Link *self, const struct iovec *parts, int count, ssize_t size, struct output *output)
{
    struct unsent *unsent = send_or_queue(self, parts, count, size, output, 0);
    if (unsent && unsent == self->unsent)
        note_link(self);
}

/* Send the lent message, and what was queued behind it, as far as there is room.  The caller has the lock of the link. */
static void send_queued(Link *self)
{
    struct unsent *unsent;
    while (!self->muted && (unsent = self->unsent)) {
        const struct iovec whole = {unsent->data, (size_t)unsent->size};
        if (!unsent->parts && !unsent->data)
            return; /* there was no memory for it: Python counts it */
        ssize_t sent = unsent->parts ? send_behind(self, unsent->parts, unsent->parts_count, unsent->sent)
                                     : send_behind(self, &whole, 1, unsent->sent);
        if (sent <= 0)
            return;
        unsent->sent += sent;
        if (unsent->sent < unsent->size)
            continue;
        self->sent_messages++;
        self->sent_bytes += unsent->size;
        forget_unsent(self);
    }
    self->clear = !self->unsent && !self->muted;
}

/* Copy the lent message, which is Python's from here on.  The caller has the lock of the link. */
static void own_lent(Link *self)
{
    struct unsent *unsent = self->lent;
    if ((unsent->data = malloc((size_t)unsent->size)))
        join_parts(unsent->data, unsent->parts, unsent->parts_count);
    unsent->parts = NULL;
    self->lent = NULL, self->lent_bytes = 0;
}

/* Send a large message.  Where the peer is about to take the rest, this waits for that, without the lock of the link, instead
 * of copying the message for Python. */
static void send_large_to_link(Link *self, const struct iovec *parts, int count, ssize_t size, struct output *output)
{
    pthread_mutex_lock(&self->sending->mutex);
    const struct unsent *unsent = send_or_queue(self, parts, count, size, output, 1);
    int64_t until_ns = unsent ? clock_ns(CLOCK_MONOTONIC) + ROOM_NS : 0;
    while (unsent && self->lent == unsent) { /* else it is sent, or Python has taken it */
        int64_t left_ns = until_ns - clock_ns(CLOCK_MONOTONIC);
        struct pollfd room = {.fd = self->fd, .events = POLLOUT};
        pthread_mutex_unlock(&self->sending->mutex);
        int has_room = left_ns > 0 && poll(&room, 1, (int)(left_ns / 1000000) + 1) > 0 && room.revents == POLLOUT;
        pthread_mutex_lock(&self->sending->mutex);
        if (self->lent == unsent && has_room && !self->muted)
            send_queued(self);
        else if (self->lent == unsent)
            own_lent(self);
    }
    if (unsent && self->unsent)
        note_link(self);
    pthread_mutex_unlock(&self->sending->mutex);
}

/* -- ROS to OpenIGTLink ------------------------------------------------------------------------------------------------ */

/* Build the messages of bulk; 0: it must go to Python. */
static int build_bulk(Passage *self, Stream *stream, const struct found *found, int64_t shown_ns, ssize_t *sizes)
{
    struct igtl_form forms[MAX_OUTPUTS] = {{0}};
    for (int i = 0; i < stream->output_count; i++) {
        const struct output *output = &stream->outputs[i];
        sizes[i] = output->size + found->size + output->tail_size;
        if (sizes[i] > LARGEST_OUTPUT)
            return 0;
        forms[i] = (struct igtl_form){output->template, output->tail, output->size, output->tail_size, output->digits_at,
                                      scratch_of(self, i)};
    }
    return bulk_from_ros(&stream->bulk_from_ros, found, forms, stream->output_count, shown_ns);
}

/* As pass_to_ros. */
static int pass_to_igtl(Passage *self, Stream *stream, const uint8_t *cdr, ssize_t size, int64_t source_ns,
                        int64_t begun_ns)
{
    int64_t stamp_ns, header_ns, now_ns = time_of_input(self, &stamp_ns), locked_ns = clock_ns(CLOCK_MONOTONIC);
    double numbers[12], place[3];
    struct found found = {0};
    int is_bulk = stream->is_bulk, count = stream->output_count;
    if (!now_ns || (is_bulk ? size > LARGEST_INPUT || !find_in_ros(&stream->bulk_from_ros, cdr, size, &found)
                            : !pose_from_ros(&stream->from_ros, cdr, size, &header_ns, numbers)))
        return 0;
    if (is_bulk)
        header_ns = found.header_ns;
    int64_t sent_ns = header_ns ? header_ns : source_ns;
    int64_t shown_ns = stream->own && sent_ns > 0 ? sent_ns : stamp_ns;
    struct output *built[MAX_OUTPUTS];
    ssize_t bytes = size, sizes[MAX_OUTPUTS];
    for (int i = 0; i < count; i++) {
        built[i] = &stream->outputs[i];
        sizes[i] = built[i]->size;
        if (!fits_digits(built[i]->digits_at, header_ns, shown_ns))
            return 0;
    }
    if (is_bulk && !build_bulk(self, stream, &found, shown_ns, sizes))
        return 0;
    for (int i = 0; i < count; i++)
        bytes += sizes[i];
    if (!is_bulk)
        memcpy(place, cdr + stream->place_at, sizeof place);
    if (!begin_record(self, stream, built, count, bytes, LARGEST_RECORDED))
        return 0;
    if (!lock_links(stream)) {
        end_record(self);
        return 0;
    }
    if (!passes_guard(stream->guard, stamp_ns, shown_ns, is_bulk ? NULL : place)) {
        unlock_links(stream, count, 0);
        end_record(self);
        return 0;
    }
    uint64_t seq = take_numbers(self, count, now_ns, stamp_ns);
    int64_t converted_ns = clock_ns(CLOCK_MONOTONIC);
    for (int i = 0; i < count; i++) {
        struct output *output = built[i];
        uint8_t *message = scratch_of(self, i);
        if (!is_bulk) {
            memcpy(message, output->template, output->size);
            put_u64(message + TICKS_AT, ns_to_ticks(shown_ns));
            put_igtl_pose(message, output->size, output->at, stream->from_ros.bytes, output->digits_at, numbers, header_ns,
                          shown_ns);
        }
        const struct iovec whole = {message, (size_t)sizes[i]};
        for (int k = 0; k < output->link_count; k++)
            send_to_link(output->links[k], &whole, 1, sizes[i], output);
        output->sent++;
    }
    unlock_links(stream, count, 0);
    int64_t passed_ns = clock_ns(CLOCK_MONOTONIC);
    record(self, stream, built, sizes, count, seq, stamp_ns, source_ns, shown_ns, cdr, size);
    if (source_ns)
        count_time(self, TO_IGTL, MIDDLEWARE, now_ns - self->ahead_ns - source_ns - (locked_ns - begun_ns));
    count_times(self, TO_IGTL, locked_ns - begun_ns, converted_ns - locked_ns, passed_ns - converted_ns);
    count_recording(self, TO_IGTL, passed_ns);
    stream->received++;
    stream->converted++;
    set_latest(stream, seq, stamp_ns, source_ns, NULL);
    stream->latest_size = size;
    memcpy(stream->latest, cdr, size);
    attend_recorder(self);
    return 1;
}

/* -- subscriptions --------------------------------------------------------------------------------------------------------- */

enum { IDLE, TAKING, WITH_PYTHON }; /* who takes from a subscription: no thread, one of the middleware, or Python */

struct Subscription {
    PyObject_HEAD
    Passage *passage;
    const void *pointer; /* rcl_subscription_t */
    Stream *stream;      /* owned; guarded by the sequence lock; NULL: all messages are Python's */
    pthread_mutex_t state;
    int taker, is_pending, is_ready, failure;
    struct rcl_serialized message; /* of the taker */
    struct rcl_message_info info;
    size_t last_size; /* of the last message */
    int is_held;      /* the message was taken, and has not passed */
    int is_refused;   /* it is large, and for Python */
    /* losses, for TopicSubscription */
    uint64_t last_number;
    long long received, missing;
    Subscription *next_ready;
};

/* Let a subscription wait for its turn in the thread of subscriptions.  The caller has `events`. */
static void put_last(Passage *passage, Subscription *self)
{
    self->is_ready = 1;
    self->next_ready = NULL;
    *passage->ready_end = self;
    passage->ready_end = &self->next_ready;
}

/* Have that thread take from the subscription. */
static void note_subscription(Subscription *self)
{
    Passage *passage = self->passage;
    pthread_mutex_lock(&passage->events);
    if (!self->is_ready) {
        put_last(passage, self);
        pthread_cond_signal(&passage->taken_over);
    }
    pthread_mutex_unlock(&passage->events);
}

static void count_received(Subscription *self)
{
    uint64_t number = self->info.publication_number;
    add(&self->received);
    if (!number)
        return;
    if (self->last_number && number > self->last_number + 1)
        __atomic_add_fetch(&self->missing, (long long)(number - self->last_number - 1), __ATOMIC_RELAXED);
    self->last_number = number;
}

/* A large message to OpenIGTLink: its outputs, with stamps in the header that are still to be set. */
struct large_outputs {
    struct output *outputs[MAX_OUTPUTS];
    struct iovec parts[MAX_OUTPUTS][MAX_PARTS];
    ssize_t sizes[MAX_OUTPUTS], bytes;
    int count, parts_count;
    uint8_t *made;
};

/* Make the outputs of a large message, whose pixels stay where they are if they need not be changed; 0: Python's.
 *
 * sent_ns: stamp of its sender; without one, or if it does not count, metadata with the stamp of the message cannot be
 * made before that is known. */
static int make_large(Stream *stream, const struct found *found, int64_t sent_ns, struct large_outputs *large)
{
    struct igtl_form forms[MAX_OUTPUTS] = {{0}};
    int apart = stream->bulk_from_ros.form == PICTURE;
    int64_t shown_ns = stream->own ? sent_ns : 0;
    ssize_t made = 0;
    large->count = stream->output_count, large->parts_count = apart ? MAX_PARTS : 1;
    large->bytes = 0;
    for (int i = 0; i < large->count; i++) {
        const struct output *output = large->outputs[i] = &stream->outputs[i];
        large->sizes[i] = output->size + found->size + output->tail_size;
        large->bytes += large->sizes[i];
        made += large->sizes[i] - (apart ? found->size : 0);
        if (!fits_digits(output->digits_at, found->header_ns, shown_ns) || large->bytes > LARGEST_MADE)
            return 0;
    }
    uint8_t *end = large->made = malloc((size_t)made + 1);
    for (int i = 0; end && i < large->count; i++) {
        const struct output *output = large->outputs[i];
        struct iovec *parts = large->parts[i];
        forms[i] = (struct igtl_form){output->template, output->tail, output->size, output->tail_size, output->digits_at, end};
        if (apart) {
            parts[0] = (struct iovec){end, (size_t)output->size};
            parts[1] = (struct iovec){(void *)(uintptr_t)found->data, (size_t)found->size};
            parts[2] = (struct iovec){end + output->size, (size_t)output->tail_size};
            end += output->size + output->tail_size;
        } else {
            parts[0] = (struct iovec){end, (size_t)large->sizes[i]};
            end += large->sizes[i];
        }
    }
    if (end && apart)
        frame_pixels(found, forms, large->count, shown_ns);
    return end && (apart || bulk_from_ros(&stream->bulk_from_ros, found, forms, large->count, shown_ns));
}

/* Whether a link of a stream has more to send than the passage may add to. */
static int is_behind(const Stream *stream)
{
    for (int i = 0; i < stream->output_count; i++)
        for (int k = 0; k < stream->outputs[i].link_count; k++)
            if (__atomic_load_n(&stream->outputs[i].links[k]->unsent_bytes, __ATOMIC_RELAXED) > MOST_UNSENT)
                return 1;
    return 0;
}

/* As admit_to_ros. */
static int admit_to_igtl(Subscription *self, Stream *stream, const struct found *found, const struct large_outputs *large,
                         struct kept *kept, uint8_t **slots)
{
    Passage *passage = self->passage;
    ssize_t size = (ssize_t)kept->message.length;
    int64_t stamp_ns = 0, now_ns = time_of_input(passage, &stamp_ns), source_ns = self->info.source_ns;
    int64_t sent_ns = found->header_ns ? found->header_ns : source_ns;
    int64_t shown_ns = stream->own && sent_ns > 0 ? sent_ns : stamp_ns;
    if (!now_ns || self->stream != stream || is_behind(stream) ||
        !begin_record(passage, stream, large->outputs, large->count, size + large->bytes, size + large->bytes))
        return 0;
    if (!passes_guard(stream->guard, stamp_ns, shown_ns, NULL)) {
        end_record(passage);
        return 0;
    }
    uint64_t seq = take_numbers(passage, large->count, now_ns, stamp_ns);
    reserve(passage, stream, large->outputs, large->sizes, large->count, seq, stamp_ns, source_ns, shown_ns, size, slots);
    for (int i = 0; i < large->count; i++) {
        put_u64((uint8_t *)large->parts[i][0].iov_base + TICKS_AT, ns_to_ticks(shown_ns));
        large->outputs[i]->sent++;
    }
    stream->received++;
    stream->converted++;
    set_latest(stream, seq, stamp_ns, source_ns, kept);
    if (source_ns)
        count_time(passage, TO_IGTL, MIDDLEWARE, now_ns - passage->ahead_ns - source_ns);
    return 1;
}

/* As pass_large_to_ros. */
static int pass_large_to_igtl(Subscription *self, Stream *stream, struct kept *kept)
{
    Passage *passage = self->passage;
    int64_t begun_ns = clock_ns(CLOCK_MONOTONIC);
    struct found found = {0};
    struct large_outputs large = {.made = NULL};
    struct unfilled *unfilled = calloc(1, sizeof *unfilled);
    uint8_t *slots[1 + MAX_OUTPUTS] = {NULL};
    int passes = unfilled && stream->is_bulk &&
                 find_in_ros(&stream->bulk_from_ros, kept->message.buffer, (ssize_t)kept->message.length, &found) &&
                 make_large(stream, &found, self->info.source_ns, &large);
    int64_t converted_ns = clock_ns(CLOCK_MONOTONIC), locked_ns = converted_ns;
    if (passes) {
        wait_for_sequence(passage);
        locked_ns = clock_ns(CLOCK_MONOTONIC);
        passes = admit_to_igtl(self, stream, &found, &large, kept, slots);
        unlock_sequence(passage);
    }
    if (passes) {
        for (int i = 0; i < large.count; i++)
            for (int k = 0; k < large.outputs[i]->link_count; k++) {
                Link *link = large.outputs[i]->links[k];
                send_large_to_link(link, large.parts[i], large.parts_count, large.sizes[i], large.outputs[i]);
            }
        *unfilled = (struct unfilled){.direction = TO_IGTL, .passed_ns = clock_ns(CLOCK_MONOTONIC)};
        const struct iovec input = {kept->message.buffer, kept->message.length};
        add_entry(unfilled, slots[0], &input, 1);
        for (int i = 0; i < large.count; i++)
            add_entry(unfilled, slots[1 + i], large.parts[i], large.parts_count);
        count_times(passage, TO_IGTL, locked_ns - converted_ns, converted_ns - begun_ns, unfilled->passed_ns - locked_ns);
        fill_later(passage, unfilled, kept, large.made, large.bytes);
        return 1;
    }
    free(unfilled);
    free(large.made);
    return 0;
}

/* Pass on the held message, a large one, without the sequence lock, except for its number; 0: it is Python's. */
static int pass_held(Subscription *self)
{
    size_t size = self->message.length;
    wait_for_sequence(self->passage);
    Stream *stream = self->stream;
    if (stream)
        __atomic_store_n(&stream->is_in_use, 1, __ATOMIC_RELEASE);
    unlock_sequence(self->passage);
    struct kept *kept = stream && size > LARGEST_INPUT ? keep(&self->message) : NULL;
    int passed = kept && pass_large_to_igtl(self, stream, kept);
    if (stream)
        __atomic_store_n(&stream->is_in_use, 0, __ATOMIC_RELEASE);
    if (!passed) {
        free(kept);
        return 0;
    }
    leave_kept(kept);
    self->message.buffer = NULL;
    self->message.length = self->message.capacity = 0;
    self->last_size = size;
    self->is_held = 0;
    count_received(self);
    return 1;
}

/* Pass on a message that was taken; 0: it is Python's.  The caller has the sequence lock. */
static int pass_taken(Subscription *self, int64_t begun_ns)
{
    if (!self->stream || !pass_to_igtl(self->passage, self->stream, self->message.buffer,
                                       (ssize_t)self->message.length, self->info.source_ns, begun_ns))
        return 0;
    self->last_size = self->message.length;
    count_received(self);
    return 1;
}

/* Pass on what was taken (`is_held`) and what is there, until nothing is left, which is RCL_RET_SUBSCRIPTION_TAKE_FAILED.
 * Or return another code: RCL_RET_OK where a message is held for Python, where the sequence lock was not to be had, and
 * after a large one: others have their turn.
 *
 * Several messages pass with one taking of the lock: where many want it, who takes it for each message waits each time.
 * Only the taker of a subscription takes from it, so a thread that waits for the lock has no lock of the middleware that
 * this one needs. */
static int pass_all(Subscription *self, int is_of_middleware)
{
    Passage *passage = self->passage;
    for (;;) {
        int code = RCL_RET_OK;
        if (!self->is_held && (code = passage->take(self->pointer, &self->message, &self->info, NULL)) != RCL_RET_OK)
            return code;
        self->is_held = 1;
        int64_t now_ns = clock_ns(CLOCK_MONOTONIC);
        if (self->message.length > LARGEST_INPUT || !__atomic_load_n(&self->stream, __ATOMIC_RELAXED)) {
            if (!is_of_middleware && !self->is_refused)
                self->is_refused = !pass_held(self);
            return RCL_RET_OK;
        }
        if (!is_of_middleware)
            wait_for_sequence(passage);
        else if (!lock_sequence(passage))
            return RCL_RET_OK;
        int64_t until_ns = clock_ns(CLOCK_MONOTONIC) + BATCH_NS; /* the time that it waited does not count */
        while (self->message.length <= LARGEST_INPUT && pass_taken(self, now_ns)) {
            self->is_held = 0;
            now_ns = clock_ns(CLOCK_MONOTONIC);
            if (now_ns >= until_ns ||
                (code = passage->take(self->pointer, &self->message, &self->info, NULL)) != RCL_RET_OK)
                break;
            self->is_held = 1;
        }
        unlock_sequence(passage);
        if (self->is_held || code != RCL_RET_OK)
            return code;
    }
}

/* Pass on what waits, in a thread without locks of the middleware that has taken over; the last code of pass_all. */
static int pass_waiting(Subscription *self)
{
    for (;;) {
        pthread_mutex_lock(&self->state);
        self->is_pending = 0;
        pthread_mutex_unlock(&self->state);
        int code = pass_all(self, 0);
        if (code != RCL_RET_SUBSCRIPTION_TAKE_FAILED)
            return code;
        pthread_mutex_lock(&self->state);
        int idle = !self->is_pending;
        if (idle)
            self->taker = IDLE;
        pthread_mutex_unlock(&self->state);
        if (idle)
            return code;
    }
}

/* A thread of the middleware has a message for the subscription: take it here if its stream is compiled. */
static void on_message(const void *user_data, size_t events)
{
    Subscription *self = (Subscription *)user_data;
    Passage *passage = self->passage;
    (void)events;
    pthread_mutex_lock(&self->state);
    self->is_pending = 1;
    if (self->taker != IDLE) {
        pthread_mutex_unlock(&self->state);
        return;
    }
    /* A thread that publishes with the sequence lock may be called for a subscription of its own node. */
    int passes = !has_sequence(passage) && __atomic_load_n(&self->stream, __ATOMIC_RELAXED) &&
                 self->last_size <= LARGEST_INPUT; /* the next one is as large as the last */
    self->taker = passes ? TAKING : WITH_PYTHON;
    pthread_mutex_unlock(&self->state);
    while (passes) {
        pthread_mutex_lock(&self->state);
        self->is_pending = 0;
        pthread_mutex_unlock(&self->state);
        int code = pass_all(self, 1);
        pthread_mutex_lock(&self->state);
        if (code != RCL_RET_SUBSCRIPTION_TAKE_FAILED) {
            self->failure = code == RCL_RET_OK ? 0 : code;
            passes = 0;
        } else if (!self->is_pending) {
            self->taker = IDLE;
            pthread_mutex_unlock(&self->state);
            return;
        }
        if (!passes)
            self->taker = WITH_PYTHON;
        pthread_mutex_unlock(&self->state);
    }
    note_subscription(self);
}

/* -- Python: streams ------------------------------------------------------------------------------------------------------ */

static void free_stream(Stream *self)
{
    free(self->sample);
    free(self->latest);
    leave_kept(self->large);
    for (int i = 0; i < self->output_count; i++) {
        struct output *output = &self->outputs[i];
        free(output->template);
        free(output->tail);
        free(output->channel);
        Py_XDECREF((PyObject *)output->publisher);
        for (int k = 0; k < output->link_count; k++)
            Py_DECREF((PyObject *)output->links[k]);
    }
    Py_XDECREF((PyObject *)self->link);
    Py_XDECREF((PyObject *)self->subscription);
    Py_XDECREF((PyObject *)self->guard);
    Py_XDECREF((PyObject *)self->passage);
    Py_TYPE(self)->tp_free((PyObject *)self);
}

/* Free what was in use when the last reference went, and is not any more; the caller has the GIL. */
static void free_left(Passage *passage)
{
    Stream **at = &passage->left_streams;
    while (*at) {
        Stream *stream = *at;
        if (__atomic_load_n(&stream->is_in_use, __ATOMIC_ACQUIRE)) {
            at = &stream->next;
            continue;
        }
        *at = stream->next;
        free_stream(stream);
    }
}

static void stream_dealloc(Stream *self)
{
    if (__atomic_load_n(&self->is_in_use, __ATOMIC_ACQUIRE)) {
        self->next = self->passage->left_streams;
        self->passage->left_streams = self;
    } else {
        free_stream(self);
    }
}

static PyObject *stream_remove(Stream *self, PyObject *nothing)
{
    (void)nothing;
    if (self->link) {
        Stream **at = &self->link->streams[bucket_of(self->names)];
        while (*at && *at != self)
            at = &(*at)->next;
        if (*at) {
            *at = self->next;
            self->link->stream_count--;
            Py_DECREF(self);
        }
    } else if (self->subscription && self->subscription->stream == self) {
        __atomic_store_n(&self->subscription->stream, NULL, __ATOMIC_RELAXED);
        Py_DECREF(self);
    }
    Py_RETURN_NONE;
}

/* The latest message of a stream with one; Python gets the memory of a large one, unless a thread still reads it. */
static PyObject *latest_bytes(Stream *self)
{
    struct kept *large = self->large;
    if (!large)
        return PyBytes_FromStringAndSize((const char *)self->latest, self->latest_size);
    int is_read = __atomic_load_n(&large->owners, __ATOMIC_ACQUIRE) > 1;
    PyObject *bytes = is_read ? PyBytes_FromStringAndSize((const char *)large->message.buffer,
                                                          (Py_ssize_t)large->message.length)
                              : python_bytes(&large->message);
    if (bytes) {
        self->large = NULL;
        leave_kept(large);
    }
    return bytes;
}

static PyObject *stream_collect(Stream *self, PyObject *nothing)
{
    (void)nothing;
    PyObject *sent = PyTuple_New(self->output_count), *ignored = PyTuple_New(self->output_count), *found = NULL;
    for (int i = 0; sent && ignored && i < self->output_count; i++) {
        struct output *output = &self->outputs[i];
        PyTuple_SET_ITEM(sent, i, PyLong_FromUnsignedLongLong(output->sent));
        PyTuple_SET_ITEM(ignored, i, PyLong_FromLongLong(taken(&output->ignored)));
        output->sent = 0;
    }
    uint64_t seq = self->latest_seq;
    PyObject *latest = Py_NewRef(Py_None), *bytes = seq ? latest_bytes(self) : NULL;
    if (seq)
        Py_SETREF(latest, bytes ? Py_BuildValue("KLLNI", (unsigned long long)seq, (long long)self->latest_stamp_ns,
                                                (long long)self->latest_source_ns, bytes, self->waits)
                                : NULL);
    self->latest_seq = 0;
    if (sent && ignored && latest)
        found = Py_BuildValue("KKKOOO", (unsigned long long)self->received, (unsigned long long)self->converted,
                              (unsigned long long)self->unheard, sent, ignored, latest);
    Py_XDECREF(sent);
    Py_XDECREF(ignored);
    Py_XDECREF(latest);
    if (found)
        self->received = self->converted = self->unheard = 0;
    return found;
}

static PyObject *guard_collect(Guard *guard, PyObject *nothing)
{
    (void)nothing;
    PyObject *found = NULL, *looks = PyList_New(guard->observed);
    PyObject *place = guard->has_place ? Py_BuildValue("ddd", guard->place[0], guard->place[1], guard->place[2])
                                       : Py_NewRef(Py_None);
    for (int i = 0; looks && i < guard->observed; i++)
        PyList_SET_ITEM(looks, i, Py_BuildValue("LL", (long long)guard->observations[i][0],
                                                (long long)guard->observations[i][1]));
    if (place && looks)
        found = Py_BuildValue("(LLLLLLO)O", (long long)guard->last_ns, (long long)guard->look_ns,
                              (long long)guard->due_ns, (long long)guard->seen_ns, (long long)guard->arrived_ns,
                              (long long)guard->still, place, looks);
    Py_XDECREF(place);
    Py_XDECREF(looks);
    if (found) {
        guard->observed = 0;
        guard->is_dirty = 0;
    }
    return found;
}

static PyObject *guard_set(Guard *guard, PyObject *args)
{
    int watches, judged, knows_age;
    long long max_age_ns, ahead_ns, last_ns, look_ns, due_ns, episode_ends_ns, seen_ns, arrived_ns, still;
    PyObject *place;
    if (!PyArg_ParseTuple(args, "pppLLLLLLLLLO", &watches, &judged, &knows_age, &max_age_ns, &ahead_ns, &last_ns, &look_ns,
                          &due_ns, &episode_ends_ns, &seen_ns, &arrived_ns, &still, &place))
        return NULL;
    guard->has_place = place != Py_None;
    if (guard->has_place && !PyArg_ParseTuple(place, "ddd", guard->place, guard->place + 1, guard->place + 2))
        return NULL;
    guard->watches = (char)watches, guard->judged_by_python = (char)judged, guard->knows_age = (char)knows_age;
    guard->max_age_ns = max_age_ns, guard->ahead_ns = ahead_ns, guard->last_ns = last_ns, guard->look_ns = look_ns;
    guard->due_ns = due_ns, guard->episode_ends_ns = episode_ends_ns, guard->seen_ns = seen_ns, guard->arrived_ns = arrived_ns, guard->still = still;
    Py_RETURN_NONE;
}

static PyObject *guard_passes(Guard *guard, PyObject *args)
{
    long long now_ns, stamp_ns;
    double place[3];
    if (PyTuple_GET_SIZE(args) == 2 ? !PyArg_ParseTuple(args, "LL", &now_ns, &stamp_ns)
                                    : !PyArg_ParseTuple(args, "LLddd", &now_ns, &stamp_ns, place, place + 1, place + 2))
        return NULL;
    return PyBool_FromLong(passes_guard(guard, now_ns, stamp_ns, PyTuple_GET_SIZE(args) == 2 ? NULL : place));
}

static PyMethodDef guard_methods[] = {
    {"passes", (PyCFunction)guard_passes, METH_VARARGS, "(time, stamp[, x, y, z]) -> whether it passes, for the tests."},
    {"collect", (PyCFunction)guard_collect, METH_NOARGS, "Return the state, and what was looked at since the last call."},
    {"set", (PyCFunction)guard_set, METH_VARARGS, "Set the state."},
    {NULL, NULL, 0, NULL},
};

static PyMemberDef guard_members[] = {
    {"is_dirty", T_BOOL, offsetof(Guard, is_dirty), READONLY, "Messages have changed it since the last collection."},
    {NULL, 0, 0, 0, NULL},
};

static PyTypeObject Guard_Type = {
    PyVarObject_HEAD_INIT(NULL, 0).tp_name = "igtl_gateway.native._passage.Guard",
    .tp_basicsize = sizeof(Guard),
    .tp_flags = Py_TPFLAGS_DEFAULT,
    .tp_doc = "The state of a guarded stream; all methods need the sequence lock.",
    .tp_new = PyType_GenericNew,
    .tp_methods = guard_methods,
    .tp_members = guard_members,
};

static PyObject *stream_guard_with(Stream *self, PyObject *guard)
{
    if (!PyObject_TypeCheck(guard, &Guard_Type)) {
        PyErr_SetString(PyExc_TypeError, "guard_with: not a guard");
        return NULL;
    }
    Py_XSETREF(self->guard, (Guard *)Py_NewRef(guard));
    Py_RETURN_NONE;
}

static PyMethodDef stream_methods[] = {
    {"remove", (PyCFunction)stream_remove, METH_NOARGS, "Pass no more messages; with the sequence lock."},
    {"collect", (PyCFunction)stream_collect, METH_NOARGS, "Return the counts since the last call; with the sequence lock."},
    {"guard_with", (PyCFunction)stream_guard_with, METH_O, "Check messages by a guard; with the sequence lock."},
    {NULL, NULL, 0, NULL},
};

static PyMemberDef stream_members[] = {
    {"received", T_ULONGLONG, offsetof(Stream, received), READONLY, "Messages since the last collection."},
    {"is_stale", T_BOOL, offsetof(Stream, is_stale), READONLY, "It has to be copied again."},
    {NULL, 0, 0, 0, NULL},
};

static PyTypeObject Stream_Type = {
    PyVarObject_HEAD_INIT(NULL, 0).tp_name = "igtl_gateway.native._passage.Stream",
    .tp_basicsize = sizeof(Stream),
    .tp_flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_DISALLOW_INSTANTIATION,
    .tp_doc = "A compiled stream of the native passage.",
    .tp_dealloc = (destructor)stream_dealloc,
    .tp_methods = stream_methods,
    .tp_members = stream_members,
};

static PyTypeObject Publisher_Type, Link_Type, Subscription_Type, Passage_Type;

static Stream *new_stream(Passage *passage, const char *sample, Py_ssize_t size)
{
    Stream *self = PyObject_New(Stream, &Stream_Type);
    if (!self)
        return NULL;
    memset((char *)self + offsetof(Stream, passage), 0, sizeof *self - offsetof(Stream, passage));
    self->passage = (Passage *)Py_NewRef((PyObject *)passage);
    self->sample = copied(sample, size);
    self->latest = malloc(size > LARGEST_INPUT ? size : LARGEST_INPUT);
    if (!self->sample || !self->latest) {
        Py_DECREF(self);
        PyErr_NoMemory();
        return NULL;
    }
    return self;
}

/* Note the metadata in the sample, which has room for the sizes before them if there are any. */
static void set_metadata(Stream *self, ssize_t at, ssize_t size)
{
    self->metadata = (struct metadata){self->sample + HEADER_SIZE, self->sample + at, size};
}

/* The next output; NULL: an exception is set. */
static struct output *new_output(Stream *self, const char *template, Py_ssize_t size, Py_ssize_t at, Py_ssize_t digits_at,
                                 unsigned long long number)
{
    if (self->output_count == MAX_OUTPUTS || size > LARGEST_OUTPUT) {
        PyErr_SetString(PyExc_ValueError, "more outputs, or a larger one, than the passage has room for");
        return NULL;
    }
    struct output *output = &self->outputs[self->output_count];
    output->template = copied(template, size);
    if (!output->template) {
        PyErr_NoMemory();
        return NULL;
    }
    self->output_count++;
    output->size = size, output->at = at, output->digits_at = digits_at, output->number = number;
    return output;
}

/* Have the link pass messages of a stream, until it is removed or the link is closed: it owns a reference till then. */
static PyObject *add_to_link(Stream *stream)
{
    Stream **bucket = &stream->link->streams[bucket_of(stream->names)];
    stream->next = *bucket;
    *bucket = stream;
    stream->link->stream_count++;
    return Py_NewRef((PyObject *)stream);
}

/* The same for a subscription, whose stream before it, if any, ends. */
static PyObject *set_stream(Subscription *subscription, Stream *stream)
{
    Stream *before = subscription->stream;
    __atomic_store_n(&subscription->stream, stream, __ATOMIC_RELAXED);
    Py_XDECREF((PyObject *)before);
    return Py_NewRef((PyObject *)stream);
}

/* What is left of the streams of a link that no thread reads any more. */
static void release_streams(Link *link)
{
    for (int i = 0; i < BUCKETS; i++) {
        Stream *stream = link->streams[i];
        link->streams[i] = NULL;
        while (stream) {
            Stream *next = stream->next;
            Py_DECREF((PyObject *)stream);
            stream = next;
        }
    }
    link->stream_count = 0;
}

static PyObject *passage_to_ros(Passage *self, PyObject *args)
{
    Link *link;
    const char *names, *sample;
    Py_ssize_t names_size, size, at, bytes, place_at;
    int check_crc, own;
    double times, by;
    unsigned long long number;
    PyObject *outputs;
    if (!PyArg_ParseTuple(args, "O!y#y#nnppddnKO!", &Link_Type, &link, &names, &names_size, &sample, &size, &at, &bytes,
                          &check_crc, &own, &times, &by, &place_at, &number, &PyTuple_Type, &outputs))
        return NULL;
    if (names_size != NAMES_BYTES || (bytes != MATRIX_BYTES && bytes != QUATERNION_BYTES) || at < HEADER_SIZE ||
        at + bytes > size || (at + bytes < size && at < HEADER_SIZE + EXTENDED_SIZE) || place_at < at || place_at + 12 > size) {
        PyErr_SetString(PyExc_ValueError, "to_ros: numbers outside the sample");
        return NULL;
    }
    Stream *stream = new_stream(self, sample, size);
    if (!stream)
        return NULL;
    stream->link = (Link *)Py_NewRef((PyObject *)link);
    memcpy(stream->names, names, NAMES_BYTES);
    stream->from_igtl = (struct igtl_poses){stream->sample, size, at, bytes, check_crc, times, by};
    stream->own = own, stream->place_at = place_at, stream->number = number;
    set_metadata(stream, at + bytes, size - at - bytes);
    for (Py_ssize_t i = 0; i < PyTuple_GET_SIZE(outputs); i++) {
        const char *template;
        Py_ssize_t length, stamp_at, id_at;
        Publisher *publisher;
        if (!PyArg_ParseTuple(PyTuple_GET_ITEM(outputs, i), "y#nnKO!", &template, &length, &stamp_at, &id_at, &number,
                              &Publisher_Type, &publisher))
            goto failed;
        if (!has_room_for_pose(length, stamp_at, id_at, at)) {
            PyErr_SetString(PyExc_ValueError, "to_ros: an output without room for stamp and pose or message id");
            goto failed;
        }
        struct output *output = new_output(stream, template, length, stamp_at, 0, number);
        if (!output)
            goto failed;
        output->id_at = id_at;
        output->publisher = (Publisher *)Py_NewRef((PyObject *)publisher);
    }
    return add_to_link(stream);
failed:
    Py_DECREF(stream);
    return NULL;
}

static PyObject *passage_to_ros_bulk(Passage *self, PyObject *args)
{
    Link *link;
    const char *names, *sample;
    Py_ssize_t names_size, size, at, tail;
    int check_crc, own, keeps;
    double times, by;
    unsigned long long number;
    PyObject *outputs;
    if (!PyArg_ParseTuple(args, "O!y#y#nnppddKO!p", &Link_Type, &link, &names, &names_size, &sample, &size, &at, &tail,
                          &check_crc, &own, &times, &by, &number, &PyTuple_Type, &outputs, &keeps))
        return NULL;
    if (names_size != NAMES_BYTES || tail < 0 || (tail && sample[1] != 2) || size < at + tail ||
        (size - at - tail) % POINT_BYTES || at < HEADER_SIZE + (sample[1] == 2 ? EXTENDED_SIZE : 0)) {
        PyErr_SetString(PyExc_ValueError, "to_ros_bulk: a sample that is not all but the content");
        return NULL;
    }
    Stream *stream = new_stream(self, sample, size);
    if (!stream)
        return NULL;
    stream->link = (Link *)Py_NewRef((PyObject *)link);
    memcpy(stream->names, names, NAMES_BYTES);
    stream->is_bulk = 1;
    stream->bulk_from_igtl = (struct igtl_bulk){stream->sample, at, tail, check_crc, times, by, size - at - tail};
    stream->own = own, stream->number = number, stream->keeps = (char)keeps;
    set_metadata(stream, at, tail);
    for (Py_ssize_t i = 0; i < PyTuple_GET_SIZE(outputs); i++) {
        const char *template;
        Py_ssize_t room, stamp_at, width_at, rest;
        int form;
        Publisher *publisher;
        if (!PyArg_ParseTuple(PyTuple_GET_ITEM(outputs, i), "iy#nnnKO!", &form, &template, &room, &stamp_at, &width_at,
                              &rest, &number, &Publisher_Type, &publisher))
            goto failed;
        struct output *output = new_output(stream, template, room, stamp_at, 0, number);
        if (!output)
            goto failed;
        output->form = (struct ros_form){.form = form, .template = output->template, .room = room, .stamp_at = stamp_at,
                                         .width_at = width_at, .rest = rest};
        if (form < TEXT || (form > PICTURE && form < TOOLS) || form > LANDMARKS || !has_room(&output->form) ||
            (form == METADATA && sample[1] != 2) || (form == LANDMARKS && size == at + tail)) {
            PyErr_SetString(PyExc_ValueError, "to_ros_bulk: a form without room for stamp and width");
            goto failed;
        }
        output->publisher = (Publisher *)Py_NewRef((PyObject *)publisher);
    }
    return add_to_link(stream);
failed:
    Py_DECREF(stream);
    return NULL;
}

/* Add the links that an output goes to; 0: an exception is set. */
static int add_links(struct output *output, const char *channel, PyObject *links)
{
    if (PyTuple_GET_SIZE(links) > MAX_LINKS) {
        PyErr_SetString(PyExc_ValueError, "to_igtl: more links than the passage has room for");
        return 0;
    }
    if (!(output->channel = strdup(channel))) {
        PyErr_NoMemory();
        return 0;
    }
    for (Py_ssize_t k = 0; k < PyTuple_GET_SIZE(links); k++) {
        PyObject *link = PyTuple_GET_ITEM(links, k);
        if (!PyObject_TypeCheck(link, &Link_Type)) {
            PyErr_SetString(PyExc_TypeError, "to_igtl: not a link");
            return 0;
        }
        output->links[output->link_count++] = (Link *)Py_NewRef(link);
    }
    return 1;
}

static PyObject *passage_to_igtl(Passage *self, PyObject *args)
{
    Subscription *subscription;
    const char *sample;
    Py_ssize_t size, first_end, second, end, bytes;
    int own;
    double times, by;
    unsigned long long number;
    PyObject *outputs;
    if (!PyArg_ParseTuple(args, "O!y#nnnnpddKO!", &Subscription_Type, &subscription, &sample, &size, &first_end, &second,
                          &end, &bytes, &own, &times, &by, &number, &PyTuple_Type, &outputs))
        return NULL;
    if (first_end < NAMES_AT || second < first_end || end < second || end > size - POSE_BYTES ||
        (bytes != MATRIX_BYTES && bytes != QUATERNION_BYTES)) {
        PyErr_SetString(PyExc_ValueError, "to_igtl: names outside the sample");
        return NULL;
    }
    Stream *stream = new_stream(self, sample, size);
    if (!stream)
        return NULL;
    stream->subscription = (Subscription *)Py_NewRef((PyObject *)subscription);
    stream->from_ros = (struct ros_poses){stream->sample, size, first_end, second, end, bytes, times, by};
    stream->own = own, stream->place_at = size - POSE_BYTES, stream->number = number;
    for (Py_ssize_t i = 0; i < PyTuple_GET_SIZE(outputs); i++) {
        const char *template, *channel;
        Py_ssize_t length, at, digits_at;
        PyObject *links;
        if (!PyArg_ParseTuple(PyTuple_GET_ITEM(outputs, i), "y#nnKsO!", &template, &length, &at, &digits_at, &number,
                              &channel, &PyTuple_Type, &links))
            goto failed;
        if (at < HEADER_SIZE || at + bytes > length || !has_digits(digits_at, length)) {
            PyErr_SetString(PyExc_ValueError, "to_igtl: an output without room for the numbers");
            goto failed;
        }
        struct output *output = new_output(stream, template, length, at, digits_at, number);
        if (!output || !add_links(output, channel, links))
            goto failed;
    }
    return set_stream(subscription, stream);
failed:
    Py_DECREF(stream);
    return NULL;
}

static PyObject *passage_to_igtl_bulk(Passage *self, PyObject *args)
{
    Subscription *subscription;
    const char *sample;
    Py_ssize_t size;
    int form, own;
    double times, by;
    unsigned long long number;
    PyObject *places, *outputs;
    if (!PyArg_ParseTuple(args, "O!y#O!ipddKO!", &Subscription_Type, &subscription, &sample, &size, &PyTuple_Type, &places,
                          &form, &own, &times, &by, &number, &PyTuple_Type, &outputs))
        return NULL;
    Py_ssize_t count = PyTuple_GET_SIZE(places);
    if (form < TEXT || (form > BLUE_FIRST && form != TOOLS) || form == POINT || count > MAX_PLACES || (form != TEXT && (count < 6 || count % 2))) {
        PyErr_SetString(PyExc_ValueError, "to_igtl_bulk: invalid form or places");
        return NULL;
    }
    Stream *stream = new_stream(self, sample, size);
    if (!stream)
        return NULL;
    stream->subscription = (Subscription *)Py_NewRef((PyObject *)subscription);
    stream->is_bulk = 1, stream->own = own, stream->number = number;
    struct ros_bulk *bulk = &stream->bulk_from_ros;
    *bulk = (struct ros_bulk){.sample = stream->sample, .size = size, .form = form, .times = times, .by = by};
    if (form != TEXT && !read_places(places, bulk, stream->places, count))
        goto failed;
    for (Py_ssize_t i = 0; i < PyTuple_GET_SIZE(outputs); i++) {
        const char *head, *tail, *channel;
        Py_ssize_t at, rest, digits_at;
        int keep;
        PyObject *links;
        if (!PyArg_ParseTuple(PyTuple_GET_ITEM(outputs, i), "y#y#nKspO!", &head, &at, &tail, &rest, &digits_at, &number,
                              &channel, &keep, &PyTuple_Type, &links))
            goto failed;
        if (at < HEADER_SIZE || !has_digits(digits_at, rest)) {
            PyErr_SetString(PyExc_ValueError, "to_igtl_bulk: an output without room for header or stamp");
            goto failed;
        }
        struct output *output = new_output(stream, head, at, at, digits_at, number);
        if (!output || !add_links(output, channel, links))
            goto failed;
        output->keep = (char)keep;
        output->tail_size = rest;
        if (!(output->tail = copied(tail, rest))) {
            PyErr_NoMemory();
            goto failed;
        }
    }
    return set_stream(subscription, stream);
failed:
    Py_DECREF(stream);
    return NULL;
}

/* -- Python: publishers ----------------------------------------------------------------------------------------------------- */

static PyObject *publisher_new(PyTypeObject *type, PyObject *args, PyObject *keywords)
{
    (void)keywords;
    unsigned long long pointer;
    int latched = 0;
    if (!PyArg_ParseTuple(args, "K|p", &pointer, &latched))
        return NULL;
    Publisher *self = (Publisher *)type->tp_alloc(type, 0);
    if (!self)
        return NULL;
    self->pointer = (const void *)(uintptr_t)pointer;
    if (!latched)
        return (PyObject *)self;
    self->own_messages = calloc(REMEMBERED, sizeof *self->own_messages);
    if (!self->own_messages || begin_mutex(&self->publishing)) {
        Py_DECREF(self);
        return PyErr_NoMemory();
    }
    self->latched = 1;
    return (PyObject *)self;
}

static void publisher_dealloc(Publisher *self)
{
    if (self->latched)
        pthread_mutex_destroy(&self->publishing);
    free(self->own_messages);
    Py_TYPE(self)->tp_free((PyObject *)self);
}

static PyObject *show_own(const struct own_message *own)
{
    return Py_BuildValue("LLy#", (long long)own->begun_ns, (long long)own->ended_ns, (const char *)own->bytes,
                         (Py_ssize_t)own->size);
}

static PyObject *show_size(const struct own_message *own) { return PyLong_FromSsize_t(own->whole); }

/* A list of the messages that have been published since the last call with this counter, as far as they are remembered. */
static PyObject *take_new(Publisher *self, uint64_t *taken, PyObject *(*show)(const struct own_message *))
{
    PyObject *found = PyList_New(0);
    if (!found || !self->latched)
        return found;
    lock_from_python(&self->publishing);
    uint64_t first = self->begun - *taken < REMEMBERED ? *taken : self->begun - REMEMBERED;
    for (; found && first < self->begun; first++) {
        PyObject *one = show(&self->own_messages[first % REMEMBERED]);
        if (!one || PyList_Append(found, one))
            Py_CLEAR(found);
        Py_XDECREF(one);
    }
    if (found)
        *taken = self->begun;
    pthread_mutex_unlock(&self->publishing);
    return found;
}

static PyObject *publisher_take_own(Publisher *self, PyObject *nothing)
{
    (void)nothing;
    return take_new(self, &self->taken_over, show_own);
}

static PyObject *publisher_take_sizes(Publisher *self, PyObject *nothing)
{
    (void)nothing;
    return take_new(self, &self->measured, show_size);
}

static PyObject *publisher_leave(Publisher *self, PyObject *nothing)
{
    (void)nothing;
    self->by_python = 1;
    Py_RETURN_NONE;
}

static PyObject *publisher_collect(Publisher *self, PyObject *nothing)
{
    (void)nothing;
    return Py_BuildValue("LLL", taken(&self->published), taken(&self->unheard), taken(&self->failed));
}

static PyMethodDef publisher_methods[] = {
    {"collect", (PyCFunction)publisher_collect, METH_NOARGS,
     "Return the numbers of messages since the last call: published, without a subscriber, failed."},
    {"take_own", (PyCFunction)publisher_take_own, METH_NOARGS,
     "Return begin and end (UTC ns) of the last calls for a latched topic since the last time, and the messages' first bytes."},
    {"take_sizes", (PyCFunction)publisher_take_sizes, METH_NOARGS,
     "Return the bytes of each of the last messages for a latched topic since the last time."},
    {"leave", (PyCFunction)publisher_leave, METH_NOARGS, "Leave all messages to Python, such as when our own node subscribes to the topic."},
    {NULL, NULL, 0, NULL},
};

static PyTypeObject Publisher_Type = {
    PyVarObject_HEAD_INIT(NULL, 0).tp_name = "igtl_gateway.native._passage.Publisher",
    .tp_basicsize = sizeof(Publisher),
    .tp_flags = Py_TPFLAGS_DEFAULT,
    .tp_doc = "A publisher by the address of its rcl_publisher_t (0: nothing is published), and whether it is latched.",
    .tp_new = publisher_new,
    .tp_dealloc = (destructor)publisher_dealloc,
    .tp_methods = publisher_methods,
};

/* -- Python: links ---------------------------------------------------------------------------------------------------------- */

static PyObject *link_new(PyTypeObject *type, PyObject *args, PyObject *keywords)
{
    (void)keywords;
    Passage *passage;
    Lock *sending;
    int number, fd;
    if (!PyArg_ParseTuple(args, "O!iiO!", &Passage_Type, &passage, &number, &fd, &Lock_Type, &sending))
        return NULL;
    Link *self = (Link *)type->tp_alloc(type, 0);
    if (!self)
        return NULL;
    self->passage = (Passage *)Py_NewRef((PyObject *)passage);
    self->sending = (Lock *)Py_NewRef((PyObject *)sending);
    self->number = number, self->fd = fd, self->reader = PYTHON, self->clear = 1;
    self->large_end = &self->large;
    self->unsent_end = &self->unsent;
    self->chunk = malloc(CHUNK_BYTES);
    if (!self->chunk || begin_mutex(&self->reading)) {
        Py_DECREF(self);
        return PyErr_NoMemory();
    }
    return (PyObject *)self;
}

static PyObject *link_take_pauses(Link *self, PyObject *nothing)
{
    return (void)nothing, PyLong_FromLongLong(taken(&self->pauses));
}

static PyObject *link_get_waits(Link *self, void *closure)
{
    return (void)closure, PyBool_FromLong(self->waits || self->is_limited);
}

static void link_dealloc(Link *self)
{
    free(self->chunk);
    free(self->body);
    while (self->large) {
        struct large *next = self->large->next;
        pthread_mutex_lock(&self->passage->events);
        self->passage->large_bytes -= (long long)self->large->message.length;
        pthread_mutex_unlock(&self->passage->events);
        free(self->large->message.buffer);
        free(self->large);
        self->large = next;
    }
    while (self->unsent)
        forget_unsent(self);
    pthread_mutex_destroy(&self->reading);
    Py_XDECREF((PyObject *)self->sending);
    Py_XDECREF((PyObject *)self->passage);
    Py_TYPE(self)->tp_free((PyObject *)self);
}

static PyObject *link_read_natively(Link *self, PyObject *args)
{
    double room, rate;
    if (!PyArg_ParseTuple(args, "dd", &room, &rate))
        return NULL;
    struct epoll_event event = {.events = EPOLLIN, .data.ptr = self};
    lock_from_python(&self->reading);
    self->start = self->filled = 0;
    self->room = room, self->rate = rate, self->rated_ns = clock_ns(CLOCK_MONOTONIC);
    self->reader = NATIVE;
    int failed = epoll_ctl(self->passage->epoll, EPOLL_CTL_ADD, self->fd, &event);
    if (failed)
        self->reader = PYTHON;
    pthread_mutex_unlock(&self->reading);
    return failed ? PyErr_SetFromErrno(PyExc_OSError) : Py_NewRef(Py_None);
}

static PyObject *link_read_by_python(Link *self, PyObject *nothing)
{
    (void)nothing;
    lock_from_python(&self->reading);
    if (self->reader == NATIVE) {
        self->reader = PYTHON;
        if (!self->is_paused)
            epoll_ctl(self->passage->epoll, EPOLL_CTL_DEL, self->fd, NULL);
        self->failure = 0;
    }
    self->is_paused = self->is_limited = 0;
    PyObject *rest = Py_BuildValue("y#i", (const char *)(self->body ? self->body : self->chunk + self->start),
                                   (Py_ssize_t)(self->body ? self->body_filled : self->filled - self->start),
                                   self->failure);
    free(self->body);
    self->body = NULL;
    self->start = self->filled = 0;
    pthread_mutex_unlock(&self->reading);
    return rest;
}

static PyObject *link_take_unsent(Link *self, PyObject *nothing)
{
    (void)nothing;
    struct unsent *unsent = self->unsent;
    if (!unsent)
        Py_RETURN_NONE;
    if (unsent == self->lent)
        own_lent(self);
    PyObject *found = Py_BuildValue("y#nsO", (const char *)unsent->data, (Py_ssize_t)(unsent->data ? unsent->size : 0),
                                    (Py_ssize_t)unsent->sent, unsent->channel ? unsent->channel : "",
                                    unsent->keep ? Py_True : Py_False);
    if (found)
        forget_unsent(self);
    return found;
}

static PyObject *link_add_large(Link *self, PyObject *args)
{
    const char *names;
    Py_ssize_t size, most;
    if (!PyArg_ParseTuple(args, "y#n", &names, &size, &most))
        return NULL;
    if (size != NAMES_BYTES) {
        PyErr_SetString(PyExc_ValueError, "add_large: not the names of a header");
        return NULL;
    }
    if (self->large_stream_count < MAX_LARGE_STREAMS && !most_of_large(self, (const uint8_t *)names)) {
        memcpy(self->large_streams[self->large_stream_count].names, names, NAMES_BYTES);
        self->large_streams[self->large_stream_count++].most = most;
    }
    Py_RETURN_NONE;
}

/* Whether a large message has passed natively: then it has no memory any more.  The caller has the GIL. */
static int pass_read(Link *self, struct rcl_serialized *message, int is_checked)
{
    lock_from_python(&self->passage->sequence);
    Stream *stream = (Stream *)Py_XNewRef((PyObject *)stream_of(self, message->buffer, (ssize_t)message->length));
    pthread_mutex_unlock(&self->passage->sequence);
    struct kept *kept = stream ? keep(message) : NULL;
    int passed = 0;
    if (kept) {
        Py_BEGIN_ALLOW_THREADS
        passed = pass_large_to_ros(self, stream, kept, is_checked, LARGEST_MADE);
        Py_END_ALLOW_THREADS
        if (passed) {
            message->buffer = NULL;
            leave_kept(kept);
        } else {
            free(kept);
        }
    }
    Py_XDECREF((PyObject *)stream);
    return passed;
}

static PyObject *link_take_large(Link *self, PyObject *nothing)
{
    (void)nothing;
    pthread_mutex_lock(&self->passage->events);
    struct large *large = self->large;
    if (large && !(self->large = large->next))
        self->large_end = &self->large;
    if (large)
        self->passage->large_bytes -= (long long)large->message.length;
    pthread_mutex_unlock(&self->passage->events);
    if (!large)
        Py_RETURN_NONE;
    PyObject *found = pass_read(self, &large->message, large->is_checked) ? Py_NewRef(Py_True) : python_bytes(&large->message);
    free(large->message.buffer);
    free(large);
    return found;
}

/* Python has handled a large message: read on. */
static PyObject *link_large_done(Link *self, PyObject *nothing)
{
    (void)nothing;
    struct epoll_event event = {.events = EPOLLIN, .data.ptr = self};
    __atomic_sub_fetch(&self->large_waiting, 1, __ATOMIC_SEQ_CST);
    lock_from_python(&self->reading);
    if (self->is_paused && self->reader == NATIVE) {
        self->is_paused = 0;
        epoll_ctl(self->passage->epoll, EPOLL_CTL_ADD, self->fd, &event);
    }
    pthread_mutex_unlock(&self->reading);
    Py_RETURN_NONE;
}

static PyObject *link_get_large_bytes(Link *self, void *closure)
{
    (void)closure;
    pthread_mutex_lock(&self->passage->events);
    size_t size = self->large ? self->large->message.length : 0;
    pthread_mutex_unlock(&self->passage->events);
    return PyLong_FromSize_t(size);
}

static PyObject *link_get_pending(Link *self, void *closure)
{
    return (void)closure, PyLong_FromSsize_t(self->body ? self->body_filled : self->filled - self->start);
}

/* No thread looks at the link any more: to be called before its socket is closed. */
static PyObject *link_close(Link *self, PyObject *nothing)
{
    (void)nothing;
    Passage *passage = self->passage;
    pthread_mutex_lock(&passage->events);
    for (Link **at = &passage->noted; *at; at = &(*at)->next_noted)
        if (*at == self) {
            *at = self->next_noted;
            break;
        }
    for (Link **at = &passage->with_large; *at; at = &(*at)->next_with_large)
        if (*at == self) {
            *at = self->next_with_large;
            break;
        }
    if (!self->is_closed) { /* the reading thread may know it from the events that it has just got */
        self->is_closed = self->is_noted = self->is_with_large = 1; /* from now on */
        self->next_closed = passage->closed_links;
        passage->closed_links = (Link *)Py_NewRef((PyObject *)self);
    }
    passage->woken_links = 1;
    pthread_mutex_unlock(&passage->events);
    wake_links(passage);
    Py_RETURN_NONE;
}

static PyObject *link_get_clear(Link *self, void *closure) { return (void)closure, PyBool_FromLong(self->clear); }

static int link_set_clear(Link *self, PyObject *value, void *closure)
{
    (void)closure;
    int clear = value ? PyObject_IsTrue(value) : -1;
    if (clear >= 0)
        self->clear = (char)(clear && !self->unsent);
    return clear < 0 ? -1 : 0;
}

static PyMethodDef link_methods[] = {
    {"read_natively", (PyCFunction)link_read_natively, METH_VARARGS,
     "Read in the native thread: this number of messages at once, and this number per second, which is the most at once."},
    {"read_by_python", (PyCFunction)link_read_by_python, METH_NOARGS, "Return what was read of an unfinished message, and errno."},
    {"take_unsent", (PyCFunction)link_take_unsent, METH_NOARGS, "Return a message, the bytes sent of it, its stream, and whether it is to be kept; or None."},
    {"take_pauses", (PyCFunction)link_take_pauses, METH_NOARGS, "Return how often the link was not read for a while, since the last call."},
    {"close", (PyCFunction)link_close, METH_NOARGS, "Report nothing more."},
    {"add_large", (PyCFunction)link_add_large, METH_VARARGS, "Read large messages with these names natively, up to a size; with the sequence lock."},
    {"take_large", (PyCFunction)link_take_large, METH_NOARGS, "Return the next large message, True if it has passed natively, or None: there is none; large_done must follow the first two."},
    {"large_done", (PyCFunction)link_large_done, METH_NOARGS, "A large message was handled."},
    {NULL, NULL, 0, NULL},
};

static PyMemberDef link_members[] = {
    {"number", T_INT, offsetof(Link, number), READONLY, NULL},
    {"stream_count", T_INT, offsetof(Link, stream_count), READONLY, "Compiled streams from this link."},
    {"received_messages", T_LONGLONG, offsetof(Link, received_messages), READONLY, NULL},
    {"received_bytes", T_LONGLONG, offsetof(Link, received_bytes), READONLY, NULL},
    {"room", T_DOUBLE, offsetof(Link, room), READONLY, "Messages that might have arrived at once."},
    {"pauses", T_LONGLONG, offsetof(Link, pauses), READONLY, "Pauses for which take_pauses was not called."},
    {"heard_ns", T_LONGLONG, offsetof(Link, heard_ns), READONLY, "When the last bytes came (monotonic)."},
    {"large_waiting", T_INT, offsetof(Link, large_waiting), READONLY, "Large messages that were not handled yet."},
    {"muted", T_BOOL, offsetof(Link, muted), 0, "Nothing is sent any more; with the lock of the sender."},
    {"unsent_bytes", T_LONGLONG, offsetof(Link, unsent_bytes), READONLY, "Bytes that wait for take_unsent."},
    {"sent_messages", T_LONGLONG, offsetof(Link, sent_messages), READONLY, NULL},
    {"sent_bytes", T_LONGLONG, offsetof(Link, sent_bytes), READONLY, NULL},
    {NULL, 0, 0, 0, NULL},
};

static PyObject *link_get_native(Link *self, void *closure)
{
    return (void)closure, PyBool_FromLong(self->reader == NATIVE);
}

static PyGetSetDef link_properties[] = {
    {"large_bytes", (getter)link_get_large_bytes, NULL, "Size of the large message that take_large returns; 0: there is none.", NULL},
    {"pending", (getter)link_get_pending, NULL, "Bytes of the unfinished message.", NULL},
    {"waits", (getter)link_get_waits, NULL, "The link waits for its turn in the native thread, or pauses.", NULL},
    {"is_native", (getter)link_get_native, NULL, "The native thread reads the link.", NULL},
    {"clear", (getter)link_get_clear, (setter)link_set_clear, "Nothing is queued; with the lock of the sender.", NULL},
    {NULL, NULL, NULL, NULL, NULL},
};

static PyTypeObject Link_Type = {
    PyVarObject_HEAD_INIT(NULL, 0).tp_name = "igtl_gateway.native._passage.Link",
    .tp_basicsize = sizeof(Link),
    .tp_flags = Py_TPFLAGS_DEFAULT,
    .tp_doc = "A connection: passage, number, descriptor, and the lock of its sender.",
    .tp_new = link_new,
    .tp_dealloc = (destructor)link_dealloc,
    .tp_methods = link_methods,
    .tp_members = link_members,
    .tp_getset = link_properties,
};

/* -- Python: subscriptions ------------------------------------------------------------------------------------------------- */

static PyObject *subscription_new(PyTypeObject *type, PyObject *args, PyObject *keywords)
{
    (void)keywords;
    Passage *passage;
    unsigned long long pointer;
    if (!PyArg_ParseTuple(args, "O!K", &Passage_Type, &passage, &pointer))
        return NULL;
    Subscription *self = (Subscription *)type->tp_alloc(type, 0);
    if (!self)
        return NULL;
    self->passage = (Passage *)Py_NewRef((PyObject *)passage);
    self->pointer = (const void *)(uintptr_t)pointer;
    self->message.allocator = TAKE_ALLOCATOR;
    if (begin_mutex(&self->state)) {
        Py_DECREF(self);
        return PyErr_NoMemory();
    }
    return (PyObject *)self;
}

static void subscription_dealloc(Subscription *self)
{
    free(self->message.buffer);
    pthread_mutex_destroy(&self->state);
    Py_XDECREF((PyObject *)self->passage);
    Py_TYPE(self)->tp_free((PyObject *)self);
}

/* Python takes the next message that does not pass natively, until there is none. */
static PyObject *subscription_take(Subscription *self, PyObject *nothing)
{
    (void)nothing;
    int code = self->failure;
    self->failure = 0;
    if (!code) {
        Py_BEGIN_ALLOW_THREADS
        code = pass_waiting(self);
        Py_END_ALLOW_THREADS
    }
    if (code == RCL_RET_SUBSCRIPTION_TAKE_FAILED)
        Py_RETURN_NONE;
    if (code) {
        pthread_mutex_lock(&self->state);
        self->taker = IDLE;
        pthread_mutex_unlock(&self->state);
        return PyErr_Format(PyExc_RuntimeError, "rcl cannot take a message (code %d)", code);
    }
    if (!self->is_held) /* a large one has passed */
        return PyLong_FromSize_t(self->last_size);
    self->is_held = self->is_refused = 0;
    self->last_size = self->message.length;
    PyObject *cdr = python_bytes(&self->message);
    if (!cdr)
        return NULL;
    return Py_BuildValue("NLK", cdr, (long long)self->info.source_ns, (unsigned long long)self->info.publication_number);
}

static PyObject *subscription_again(Subscription *self, PyObject *nothing)
{
    (void)nothing;
    note_subscription(self);
    Py_RETURN_NONE;
}

static PyObject *subscription_collect(Subscription *self, PyObject *nothing)
{
    (void)nothing;
    return Py_BuildValue("LLK", taken(&self->received), taken(&self->missing), (unsigned long long)self->last_number);
}

static PyMethodDef subscription_methods[] = {
    {"take", (PyCFunction)subscription_take, METH_NOARGS,
     "Return bytes, source stamp (UTC ns) and number of the next message that does not pass natively, the size of a large one "
     "that does, or None: there is none."},
    {"again", (PyCFunction)subscription_again, METH_NOARGS, "Come back to this subscription after the others."},
    {"collect", (PyCFunction)subscription_collect, METH_NOARGS,
     "Return received and missing messages since the last call, and the number of the last message."},
    {NULL, NULL, 0, NULL},
};

static PyMemberDef subscription_members[] = {
    {"last_number", T_ULONGLONG, offsetof(Subscription, last_number), 0, "Number of the last message; 0: unknown."},
    {NULL, 0, 0, 0, NULL},
};

static PyTypeObject Subscription_Type = {
    PyVarObject_HEAD_INIT(NULL, 0).tp_name = "igtl_gateway.native._passage.Subscription",
    .tp_basicsize = sizeof(Subscription),
    .tp_flags = Py_TPFLAGS_DEFAULT,
    .tp_doc = "A subscription by the address of its rcl_subscription_t.",
    .tp_new = subscription_new,
    .tp_dealloc = (destructor)subscription_dealloc,
    .tp_methods = subscription_methods,
    .tp_members = subscription_members,
};

/* -- Python: the passage ------------------------------------------------------------------------------------------------------ */

static PyObject *passage_new(PyTypeObject *type, PyObject *args, PyObject *keywords)
{
    (void)args, (void)keywords;
    Passage *self = (Passage *)type->tp_alloc(type, 0);
    if (!self)
        return NULL;
    self->ready_end = &self->ready;
    self->unfilled_end[TO_ROS] = &self->unfilled[TO_ROS], self->unfilled_end[TO_IGTL] = &self->unfilled[TO_IGTL];
    self->epoll = epoll_create1(EPOLL_CLOEXEC);
    self->wake = eventfd(0, EFD_CLOEXEC | EFD_NONBLOCK);
    self->scratch = malloc((size_t)MAX_OUTPUTS * LARGEST_OUTPUT);
    struct epoll_event event = {.events = EPOLLIN, .data.ptr = NULL};
    if (self->epoll < 0 || self->wake < 0 || !self->scratch || begin_mutex(&self->sequence) ||
        begin_mutex(&self->events) || begin_condition(&self->taken_over) ||
        begin_condition(&self->large_read) || begin_condition(&self->pressed) || epoll_ctl(self->epoll, EPOLL_CTL_ADD, self->wake, &event)) {
        Py_DECREF(self);
        return PyErr_SetFromErrno(PyExc_OSError);
    }
    return (PyObject *)self;
}

static void passage_dealloc(Passage *self)
{
    if (self->epoll > 0)
        close(self->epoll);
    if (self->wake > 0)
        close(self->wake);
    free(self->scratch);
    for (int direction = 0; direction < 2; direction++)
        fill_until(self, direction, INT64_MAX);
    Py_XDECREF((PyObject *)self->queue_lock);
    Py_XDECREF(self->queue_memory);
    Py_TYPE(self)->tp_free((PyObject *)self);
}

static PyObject *passage_enter(Passage *self, PyObject *nothing)
{
    (void)nothing;
    lock_from_python(&self->sequence);
    atomic_store_explicit(&self->owner, this_thread(), memory_order_relaxed);
    return Py_NewRef((PyObject *)self);
}

static PyObject *passage_exit(Passage *self, PyObject *args)
{
    (void)args;
    unlock_sequence(self);
    Py_RETURN_NONE;
}

static PyObject *passage_wait_links(Passage *self, PyObject *nothing)
{
    (void)nothing;
    Link *noted = NULL;
    int woken = 0;
    Py_BEGIN_ALLOW_THREADS
    self->used_ns = clock_ns(CLOCK_THREAD_CPUTIME_ID); /* what Python did since the last turn is no link's */
    while (!noted && !woken) {
        struct epoll_event events[EVENTS];
        int timeout_ms = end_pauses(self);
        int count = epoll_wait(self->epoll, events, EVENTS, self->waiting ? 0 : timeout_ms);
        for (int i = 0; i < count; i++) {
            uint64_t number;
            if (events[i].data.ptr)
                ask_for_turn(self, events[i].data.ptr);
            else if (read(self->wake, &number, sizeof number) < 0)
                continue;
        }
        take_turn(self);
        pthread_mutex_lock(&self->events);
        noted = self->noted;
        woken = self->woken_links;
        pthread_mutex_unlock(&self->events);
    }
    Py_END_ALLOW_THREADS
    PyObject *found = PyList_New(0);
    pthread_mutex_lock(&self->events);
    self->woken_links = 0;
    Link *closed = self->closed_links;
    self->closed_links = NULL;
    while (found && self->noted) {
        Link *link = self->noted;
        self->noted = link->next_noted;
        link->is_noted = 0;
        if (PyList_Append(found, (PyObject *)link))
            Py_CLEAR(found);
    }
    pthread_mutex_unlock(&self->events);
    while (closed) {
        Link *next = closed->next_closed;
        leave_turns(self, closed);
        release_streams(closed);
        Py_DECREF(closed);
        closed = next;
    }
    free_left(self);
    return found;
}

/* A thread of the middleware that has waited too long for the sequence lock leaves its messages to this thread.  They pass
 * here without the GIL, for which a thread waits long where others compute; only what does not fit is Python's. */
static PyObject *passage_wait_subscriptions(Passage *self, PyObject *nothing)
{
    (void)nothing;
    Subscription *left = NULL, **left_end = &left;
    int turns = MAX_TURNS; /* of others, while Python's messages wait */
    Py_BEGIN_ALLOW_THREADS
    pthread_mutex_lock(&self->events);
    while (!self->woken_subscriptions && (!left || (self->ready && turns--))) {
        Subscription *one = self->ready;
        if (!one) {
            wait_and_fill(self, &self->taken_over, TO_IGTL);
            continue;
        }
        if (!(self->ready = one->next_ready))
            self->ready_end = &self->ready;
        one->is_ready = 0;
        pthread_mutex_unlock(&self->events);
        int code = one->failure ? one->failure : pass_waiting(one);
        pthread_mutex_lock(&self->events);
        if (code == RCL_RET_SUBSCRIPTION_TAKE_FAILED)
            continue;
        if (code == RCL_RET_OK && !one->is_held) { /* a large one has passed */
            turns = 0;
            put_last(self, one);
            continue;
        }
        one->failure = code == RCL_RET_OK ? 0 : code;
        one->next_ready = NULL;
        *left_end = one;
        left_end = &one->next_ready;
    }
    self->woken_subscriptions = 0;
    pthread_mutex_unlock(&self->events);
    Py_END_ALLOW_THREADS
    PyObject *found = PyList_New(0);
    for (; found && left; left = left->next_ready)
        if (PyList_Append(found, (PyObject *)left))
            Py_CLEAR(found);
    return found;
}

static PyObject *passage_wait_large(Passage *self, PyObject *wanted)
{
    Link *link;
    int waits = PyObject_IsTrue(wanted);
    PyObject *found = waits < 0 ? NULL : PyList_New(0);
    Py_BEGIN_ALLOW_THREADS
    pthread_mutex_lock(&self->events);
    while (waits > 0 && !self->with_large && !self->woken_large)
        wait_and_fill(self, &self->large_read, TO_ROS);
    pthread_mutex_unlock(&self->events);
    Py_END_ALLOW_THREADS
    pthread_mutex_lock(&self->events);
    self->woken_large = 0;
    while (found && (link = self->with_large)) {
        self->with_large = link->next_with_large;
        link->is_with_large = 0;
        if (PyList_Append(found, (PyObject *)link))
            Py_CLEAR(found);
    }
    pthread_mutex_unlock(&self->events);
    return found;
}

static PyObject *passage_wait_recorder(Passage *self, PyObject *nothing)
{
    (void)nothing;
    int attends;
    Py_BEGIN_ALLOW_THREADS
    pthread_mutex_lock(&self->events);
    while (!self->attends && !self->woken_recorder)
        pthread_cond_wait(&self->pressed, &self->events);
    attends = self->attends;
    self->attends = self->woken_recorder = 0;
    pthread_mutex_unlock(&self->events);
    Py_END_ALLOW_THREADS
    return PyLong_FromSsize_t(attends ? room_ahead(self) : 0);
}

static PyObject *passage_fill(Passage *self, PyObject *nothing)
{
    (void)nothing;
    Py_BEGIN_ALLOW_THREADS
    fill_until(self, TO_ROS, INT64_MAX);
    fill_until(self, TO_IGTL, INT64_MAX);
    Py_END_ALLOW_THREADS
    Py_RETURN_NONE;
}

static PyObject *passage_wake(Passage *self, PyObject *nothing)
{
    (void)nothing;
    pthread_mutex_lock(&self->events);
    self->woken_links = self->woken_subscriptions = self->woken_large = self->woken_recorder = 1;
    pthread_cond_broadcast(&self->taken_over);
    pthread_cond_broadcast(&self->pressed);
    pthread_cond_broadcast(&self->large_read);
    pthread_mutex_unlock(&self->events);
    wake_links(self);
    Py_RETURN_NONE;
}

/* Addresses of rcl's functions; before the first subscription or publisher. */
static PyObject *passage_use_rcl(Passage *self, PyObject *args)
{
    unsigned long long take, publish_at, subscribers;
    if (!PyArg_ParseTuple(args, "KKK", &take, &publish_at, &subscribers))
        return NULL;
    self->take = (rcl_take_function)(uintptr_t)take;
    self->publish = (rcl_publish_function)(uintptr_t)publish_at;
    self->subscribers = (rcl_count_function)(uintptr_t)subscribers;
    Py_RETURN_NONE;
}

static PyObject *passage_record_into(Passage *self, PyObject *args)
{
    PyObject *memory;
    Lock *lock;
    if (!PyArg_ParseTuple(args, "OO!", &memory, &Lock_Type, &lock))
        return NULL;
    Py_buffer view;
    if (PyObject_GetBuffer(memory, &view, PyBUF_WRITABLE))
        return NULL;
    self->queue = queue_open(view.buf);
    self->queue_memory = PyMemoryView_FromObject(memory); /* the mapping stays where it is */
    PyBuffer_Release(&view);
    if (!self->queue_memory)
        return NULL;
    self->queue_lock = (Lock *)Py_NewRef((PyObject *)lock);
    self->is_recorded = 1;
    Py_RETURN_NONE;
}

static PyObject *passage_set_callback(Passage *self, PyObject *args)
{
    (void)self;
    unsigned long long function;
    Subscription *subscription;
    int on;
    if (!PyArg_ParseTuple(args, "KO!p", &function, &Subscription_Type, &subscription, &on))
        return NULL;
    rcl_set_callback_function set = (rcl_set_callback_function)(uintptr_t)function;
    int code;
    Py_BEGIN_ALLOW_THREADS
    code = set(subscription->pointer, on ? on_message : NULL, on ? subscription : NULL);
    Py_END_ALLOW_THREADS
    return PyLong_FromLong(code);
}

/* The times of both directions: for each phase a list of (upper bound in ns, messages). */
static PyObject *passage_times(Passage *self, PyObject *nothing)
{
    (void)nothing;
    PyObject *found = PyList_New(0);
    for (int direction = 0; found && direction < 2; direction++)
        for (int phase = 0; found && phase < TIMED_PHASES; phase++) {
            PyObject *row = PyList_New(0);
            for (int bucket = 0; row && bucket < TIME_BUCKETS; bucket++) {
                uint32_t count = self->times[direction][phase][bucket];
                uint64_t above = (uint64_t)(5 + (bucket & 3)) << (bucket / 4 >= 2 ? bucket / 4 - 2 : 0);
                PyObject *pair = count ? Py_BuildValue("KI", (unsigned long long)above, count) : NULL;
                if (pair && PyList_Append(row, pair))
                    Py_CLEAR(row);
                Py_XDECREF(pair);
            }
            if (!row || PyList_Append(found, row))
                Py_CLEAR(found);
            Py_XDECREF(row);
        }
    return found;
}

static PyMethodDef passage_methods[] = {
    {"times", (PyCFunction)passage_times, METH_NOARGS, "Return where the time went; with the sequence lock."},
    {"__enter__", (PyCFunction)passage_enter, METH_NOARGS, "Take the sequence lock."},
    {"__exit__", (PyCFunction)passage_exit, METH_VARARGS, "Release the sequence lock."},
    {"to_ros", (PyCFunction)passage_to_ros, METH_VARARGS, "Add a stream from a link; with the sequence lock."},
    {"to_ros_bulk", (PyCFunction)passage_to_ros_bulk, METH_VARARGS, "As to_ros, of bulk, such as strings and pictures, whose last one is kept."},
    {"to_igtl_bulk", (PyCFunction)passage_to_igtl_bulk, METH_VARARGS, "As to_igtl, of bulk."},
    {"to_igtl", (PyCFunction)passage_to_igtl, METH_VARARGS, "Add the stream of a subscription; with the sequence lock."},
    {"use_rcl", (PyCFunction)passage_use_rcl, METH_VARARGS, "Set the addresses of take, publish and count of subscribers."},
    {"record_into", (PyCFunction)passage_record_into, METH_VARARGS, "Put entries into the queue of a recorder."},
    {"set_callback", (PyCFunction)passage_set_callback, METH_VARARGS, "Let rcl call the passage for a subscription, or no more."},
    {"wait_links", (PyCFunction)passage_wait_links, METH_NOARGS, "Read links; return those that need Python."},
    {"wait_subscriptions", (PyCFunction)passage_wait_subscriptions, METH_NOARGS, "Return the subscriptions that need Python."},
    {"wait_large", (PyCFunction)passage_wait_large, METH_O, "Return the links that have read large messages since; wait for one if that is wanted."},
    {"wait_recorder", (PyCFunction)passage_wait_recorder, METH_NOARGS, "Wait until the recorder's queue needs Python; return the bytes of room that it should have, 0: nothing is to be done."},
    {"wake", (PyCFunction)passage_wake, METH_NOARGS, "End all waits."},
    {"fill", (PyCFunction)passage_fill, METH_NOARGS, "Copy what has passed to the recorder's queue; when nothing passes any more."},
    {NULL, NULL, 0, NULL},
};

static PyMemberDef passage_members[] = {
    {"seq", T_LONGLONG, offsetof(Passage, seq), 0, "Number of the last entry."},
    {"stamp_ns", T_LONGLONG, offsetof(Passage, stamp_ns), 0, "Gateway time of the last entry (UTC ns)."},
    {"last_ns", T_LONGLONG, offsetof(Passage, last_ns), 0, "Gateway time of the last input (UTC ns)."},
    {"ahead_ns", T_LONGLONG, offsetof(Passage, ahead_ns), 0, "Gateway time less the time of the host's clock (ns)."},
    {"builds_all", T_BOOL, offsetof(Passage, builds_all), 0, "Outputs without a subscriber are built, too."},
    {"large_bytes", T_LONGLONG, offsetof(Passage, large_bytes), READONLY, "Of large messages that take_large has not returned yet."},
    {"closed", T_BOOL, offsetof(Passage, closed), 0, "Every message goes to Python."},
    {NULL, 0, 0, 0, NULL},
};

static PyTypeObject Passage_Type = {
    PyVarObject_HEAD_INIT(NULL, 0).tp_name = "igtl_gateway.native._passage.Passage",
    .tp_basicsize = sizeof(Passage),
    .tp_flags = Py_TPFLAGS_DEFAULT,
    .tp_doc = "The native passage of a bridge; its context is the sequence lock.",
    .tp_new = passage_new,
    .tp_dealloc = (destructor)passage_dealloc,
    .tp_methods = passage_methods,
    .tp_members = passage_members,
};

static struct PyModuleDef definition = {PyModuleDef_HEAD_INIT, "_passage", "See igtl_gateway.native.passage.", -1, NULL,
                                        NULL, NULL, NULL, NULL};

PyMODINIT_FUNC PyInit__passage(void)
{
    begin_bytes();
    begin_bulk(1);
    if (begin_take())
        return NULL;
    PyObject *module = PyModule_Create(&definition);
    PyTypeObject *types[] = {&Lock_Type,         &Passage_Type,   &Link_Type,  &Subscription_Type,
                             &Publisher_Type, &Stream_Type, &Guard_Type};
    const char *names[] = {"Lock", "Passage", "Link", "Subscription", "Publisher", "Stream", "Guard"};
    for (size_t i = 0; module && i < sizeof types / sizeof *types; i++)
        if (PyType_Ready(types[i]) || PyModule_AddObjectRef(module, names[i], (PyObject *)types[i]))
            Py_CLEAR(module);
    return module;
}
