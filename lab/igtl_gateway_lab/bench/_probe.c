/* The loops of the native measuring programs, and of the hop that stands in for a bridge.
 *
 * Python makes the messages, the node and the sockets (probe.py, native.py, hop.py), then calls one of the loops below
 * in a thread of its own.  A loop runs without Python: ctypes releases the GIL for the call.  There are two senders of
 * a message, a publisher and a connection, and two loops that receive: a wait set of rcl, and recv.
 *
 * All times are CLOCK_MONOTONIC in ns.  A sequence number is at a fixed place of a message, see payloads.py.
 */
#define _GNU_SOURCE
#include <endian.h>
#include <errno.h>
#include <math.h>
#include <pthread.h>
#include <stdlib.h>
#include <string.h>
#include <sys/prctl.h>
#include <sys/socket.h>
#include <time.h>

#include "_rcl.h"

#define SECOND 1000000000LL
/* The kernel wakes a sleeper so much late; the rest of a wait is spent looking at the clock. */
#define SPIN_NS 20000
/* Between two looks whether a full window has room again, and whether a stopped reader may go on. */
#define LOOK_NS 50000
#define STALL_LOOK_NS 1000000
/* A sender that waits looks after this time at the latest whether it is time to stop. */
#define WAIT_NS 100000000LL
/* After this time without a new number the messages on their way are lost. */
#define PATIENCE_NS (2 * SECOND)
/* So much of small messages is sent at once in a flood. */
#define BATCH_BYTES (16 << 10)
/* Messages of one topic before the next one has its turn. */
#define TAKE_AT_MOST 32
#define BUFFER_BYTES (1 << 20)
#define MOST_TOPICS 1024

/* Of an OpenIGTLink header. */
#define DEVICE_AT 14
#define DEVICE_SIZE 20
#define BODY_SIZE_AT 42
#define CRC_AT 50
#define HEADER_SIZE 58

#define EPOCH_S 1000000000 /* seconds of the stamp of message 0 */
#define DIGITS 10

/* How a number is written. */
enum { CDR_STAMP, IGTL_STAMP, TEXT, METRES, MILLIMETRES, PIXELS, CLOUD };

struct probe_form {
    int64_t at; /* below 0: from the end */
    uint32_t kind;
    uint32_t size;
};

/* A message whose number is changed.  Its CRC is linear: each bit that differs from the first number changes the same
 * bits of it, which `flips` has (one for each bit of the number, the lowest bit of its first byte first). */
struct probe_message {
    uint8_t *bytes;
    size_t size;
    struct probe_form form;
    const uint64_t *flips; /* NULL: the number is not part of what the CRC covers */
    uint64_t crc;          /* of the first number */
    uint8_t initial[16];   /* the first number */
    int64_t id_at;            /* of the message id of header version 2, which is the number, too; 0: there is none */
    const uint64_t *id_flips; /* those of the CRC; of the first message it is 0 */
};

/* A connection; the mutex keeps messages of two threads apart. */
struct probe_link {
    int fd;
    pthread_mutex_t lock;
};

/* A stream that is sent. */
struct probe_out {
    struct probe_message message;
    const void *publisher;   /* rcl_publisher_t, or NULL */
    struct probe_link *link; /* otherwise */
    double rate_hz;          /* 0: again at once */
    int64_t count;           /* 0: until the time is over */
    int64_t offset_ns;       /* of the first, in the period */
    const int64_t *progress; /* last received number */
    int64_t window;          /* messages on their way at most, 0: any number */
    int64_t *sent;           /* times */
    int64_t capacity, done;
    int64_t over, news_ns; /* messages that are no longer on their way, and when that changed */
};

/* A stream that is received. */
struct probe_in {
    uint8_t device[DEVICE_SIZE]; /* of OpenIGTLink */
    const void *subscription;    /* rcl_subscription_t, or NULL */
    struct probe_form form;
    struct probe_out *forward; /* send it there with the same number; NULL: keep number and time */
    int64_t *progress;         /* the last number, for the sender */
    int64_t *numbers, *times;
    int64_t capacity, done;
    uint8_t *first; /* the first message with number 0, once `knocked` is 1 */
    size_t first_size;
    int32_t knocked;
};

/* rcl_wait_set_t */
struct rcl_wait_set {
    const void **subscriptions;
    size_t size_of_subscriptions;
    const void **others[10];
    void *impl;
};

struct probe_rcl {
    rcl_publish_function publish;
    rcl_take_function take;
    struct rcl_wait_set (*zero_wait_set)(void);
    int32_t (*init)(struct rcl_wait_set *set, size_t subscriptions, size_t guards, size_t timers, size_t clients,
                    size_t services, size_t events, void *context, struct rcl_allocator allocator);
    int32_t (*clear)(struct rcl_wait_set *set);
    int32_t (*add)(struct rcl_wait_set *set, const void *subscription, size_t *index);
    int32_t (*add_guard)(struct rcl_wait_set *set, const void *guard, size_t *index);
    int32_t (*wait)(struct rcl_wait_set *set, int64_t timeout_ns);
    int32_t (*fini)(struct rcl_wait_set *set);
};

static struct probe_rcl rcl;

void probe_use_rcl(const struct probe_rcl *functions) { rcl = *functions; }

/* -- time ---------------------------------------------------------------------------------------------------------- */

static int64_t now_ns(void) {
    struct timespec time;
    clock_gettime(CLOCK_MONOTONIC, &time);
    return time.tv_sec * SECOND + time.tv_nsec;
}

static void sleep_until(int64_t at_ns) {
    const struct timespec at = {at_ns / SECOND, at_ns % SECOND};
    clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &at, NULL);
}

static int stopped(const int32_t *stop) { return __atomic_load_n(stop, __ATOMIC_ACQUIRE); }

/* -- numbers ------------------------------------------------------------------------------------------------------- */

/* Read a length or a count of CDR at the next multiple of four, and go behind it; beyond the end it is 0. */
static uint32_t next_word(const uint8_t *bytes, size_t size, size_t *at) {
    uint32_t word = 0;
    *at = (*at + 3) & ~(size_t)3;
    if (*at + 4 <= size)
        memcpy(&word, bytes + *at, 4);
    *at += 4;
    return le32toh(word);
}

/* Go behind a string. */
static void skip_text(const uint8_t *bytes, size_t size, size_t *at) {
    const uint32_t length = next_word(bytes, size, at);
    *at += length;
}

/* Where the points of a PointCloud2 begin: their layout is that of the bridge. */
static size_t first_point(const uint8_t *bytes, size_t size) {
    size_t at = 4 + 8; /* encapsulation and stamp */
    skip_text(bytes, size, &at); /* frame */
    at = ((at + 3) & ~(size_t)3) + 8; /* height and width */
    for (uint32_t fields = next_word(bytes, size, &at); fields && at < size; --fields) {
        skip_text(bytes, size, &at); /* name */
        at = ((at + 3) & ~(size_t)3) + 8; /* offset and type */
        next_word(bytes, size, &at);
    }
    at += 1; /* byte order */
    at = ((at + 3) & ~(size_t)3) + 8; /* steps */
    next_word(bytes, size, &at);
    return at;
}

/* Where the number of a message is; NULL: the message is too short. */
static uint8_t *place_of(const uint8_t *bytes, size_t size, const struct probe_form *form) {
    size_t at = form->kind == CLOUD ? first_point(bytes, size) : (size_t)(form->at < 0 ? (int64_t)size + form->at : form->at);
    return at + form->size <= size ? (uint8_t *)bytes + at : NULL;
}

static void write_number(uint8_t *place, const struct probe_form *form, int64_t number) {
    uint32_t word;
    double metres;
    float millimetres;
    switch (form->kind) {
    case CDR_STAMP:
        word = htole32((uint32_t)(EPOCH_S + number));
        memcpy(place, &word, 4);
        break;
    case IGTL_STAMP:
        word = htobe32((uint32_t)(EPOCH_S + number));
        memcpy(place, &word, 4);
        break;
    case TEXT:
        for (int at = DIGITS - 1; at >= 0; --at, number /= 10)
            place[at] = (uint8_t)('0' + number % 10);
        break;
    case METRES:
        metres = (double)number * 1e-3;
        memcpy(place, &metres, 8);
        break;
    case PIXELS:
        word = htole32((uint32_t)number);
        memcpy(place, &word, 4);
        break;
    case CLOUD:
        millimetres = (float)((double)number * 1e-3); /* metres */
        memcpy(&word, &millimetres, 4);
        word = htole32(word);
        memcpy(place, &word, 4);
        break;
    default:
        millimetres = (float)number;
        memcpy(&word, &millimetres, 4);
        word = htobe32(word);
        memcpy(place, &word, 4);
    }
}

static int64_t read_number(const uint8_t *place, const struct probe_form *form) {
    uint32_t word;
    double metres;
    float millimetres;
    int64_t number = 0;
    switch (form->kind) {
    case CDR_STAMP:
        memcpy(&word, place, 4);
        return (int64_t)(int32_t)le32toh(word) - EPOCH_S;
    case IGTL_STAMP:
        memcpy(&word, place, 4);
        return (int64_t)be32toh(word) - EPOCH_S;
    case TEXT:
        for (int at = 0; at < DIGITS; ++at)
            number = 10 * number + (place[at] - '0');
        return number;
    case METRES:
        memcpy(&metres, place, 8);
        return llround(metres * 1e3);
    case PIXELS:
        memcpy(&word, place, 4);
        return le32toh(word);
    case CLOUD:
        memcpy(&word, place, 4);
        word = le32toh(word);
        memcpy(&millimetres, &word, 4);
        return llround((double)millimetres * 1e3);
    default:
        memcpy(&word, place, 4);
        word = be32toh(word);
        memcpy(&millimetres, &word, 4);
        return llround(millimetres);
    }
}

void probe_set_number(struct probe_message *message, int64_t number) {
    const struct probe_form *form = &message->form;
    uint8_t *place = place_of(message->bytes, message->size, form);
    write_number(place, form, number);
    if (!message->flips)
        return;
    uint64_t crc = message->crc;
    for (uint32_t at = 0; at < form->size; ++at)
        for (unsigned differs = place[at] ^ message->initial[at]; differs; differs &= differs - 1)
            crc ^= message->flips[8 * at + (unsigned)__builtin_ctz(differs)];
    if (message->id_at) {
        const uint32_t id = htobe32((uint32_t)number);
        uint8_t *id_place = message->bytes + message->id_at;
        memcpy(id_place, &id, 4);
        for (uint32_t at = 0; at < 4; ++at)
            for (unsigned set = id_place[at]; set; set &= set - 1)
                crc ^= message->id_flips[8 * at + (unsigned)__builtin_ctz(set)];
    }
    crc = htobe64(crc);
    memcpy(message->bytes + CRC_AT, &crc, 8);
}

/* -- sending ------------------------------------------------------------------------------------------------------- */

struct probe_link *probe_link_new(int fd) {
    struct probe_link *link = calloc(1, sizeof *link);
    if (link) {
        link->fd = fd;
        pthread_mutex_init(&link->lock, NULL);
    }
    return link;
}

/* Another connection; -1: none, messages to it are dropped. */
void probe_link_set(struct probe_link *link, int fd) {
    pthread_mutex_lock(&link->lock);
    link->fd = fd;
    pthread_mutex_unlock(&link->lock);
}

static int32_t send_all(struct probe_link *link, const uint8_t *bytes, size_t size) {
    int32_t fault = 0;
    pthread_mutex_lock(&link->lock);
    while (size && link->fd >= 0) {
        const ssize_t sent = send(link->fd, bytes, size, MSG_NOSIGNAL);
        if (sent < 0 && errno == EINTR)
            continue;
        if (sent < 0) {
            fault = errno;
            break;
        }
        bytes += sent;
        size -= (size_t)sent;
    }
    pthread_mutex_unlock(&link->lock);
    return fault;
}

static int32_t send_bytes(const struct probe_out *out, uint8_t *bytes, size_t size) {
    if (!out->publisher)
        return send_all(out->link, bytes, size);
    struct rcl_serialized serialized = {bytes, size, size, {0}};
    return rcl.publish(out->publisher, &serialized, NULL);
}

static int room_for(int64_t **times, int64_t *capacity, int64_t needed) {
    if (needed <= *capacity)
        return 1;
    const int64_t wanted = needed > 2 * *capacity ? needed : 2 * *capacity;
    int64_t *grown = realloc(*times, (size_t)wanted * sizeof **times);
    if (!grown)
        return 0;
    *times = grown;
    *capacity = wanted;
    return 1;
}

/* One message, at once; number 0 knocks. */
int32_t probe_send_one(struct probe_out *out, int64_t number) {
    probe_set_number(&out->message, number);
    return send_bytes(out, out->message.bytes, out->message.size);
}

/* The next messages; small ones of a flood over a connection in blocks, with one time. */
static int32_t send_next(struct probe_out *out, int64_t many, uint8_t *block) {
    const size_t size = out->message.size;
    if (!room_for(&out->sent, &out->capacity, out->done + many))
        return ENOMEM;
    while (many) {
        int64_t together = 1;
        int32_t fault;
        if (many > 1 && !out->publisher && 2 * size <= BATCH_BYTES) {
            for (together = 0; together < many && (size_t)(together + 1) * size <= BATCH_BYTES; ++together) {
                probe_set_number(&out->message, out->done + 1 + together);
                memcpy(block + (size_t)together * size, out->message.bytes, size);
            }
            const int64_t at_ns = now_ns();
            for (int64_t each = 0; each < together; ++each)
                out->sent[out->done + each] = at_ns;
            fault = send_bytes(out, block, (size_t)together * size);
        } else {
            probe_set_number(&out->message, out->done + 1);
            out->sent[out->done] = now_ns();
            fault = send_bytes(out, out->message.bytes, size);
        }
        if (fault)
            return fault;
        out->done += together;
        many -= together;
    }
    return 0;
}

/* How many messages may be sent now; see window.py. */
static int64_t room_of(struct probe_out *out, int64_t at_ns) {
    if (!out->window)
        return 1;
    const int64_t heard = __atomic_load_n(out->progress, __ATOMIC_ACQUIRE);
    if (heard > out->over || !out->news_ns) {
        out->over = heard > out->over ? heard : out->over;
        out->news_ns = at_ns;
    } else if (out->done - out->over >= out->window && at_ns - out->news_ns > PATIENCE_NS) {
        out->over = out->done;
    }
    int64_t room = out->window - (out->done - out->over);
    const int64_t worth = out->window / 4 > 1 ? out->window / 4 : 1;
    if (room < worth)
        return 0;
    return out->count && room > out->count - out->done ? out->count - out->done : room;
}

static int64_t due_of(const struct probe_out *out, int64_t begin_ns) {
    return begin_ns + out->offset_ns + (int64_t)((double)out->done * (double)SECOND / out->rate_hz);
}

/* Send all streams at their rates; absolute deadlines, so that a late message makes none later.
 *
 * Streams without a count end at `until_ns`, all at once when `stop` becomes 1.  Returns 0 or the code of rcl or errno.
 */
int32_t probe_send(struct probe_out **outs, int32_t number, int64_t begin_ns, int64_t until_ns, const int32_t *stop) {
    prctl(PR_SET_TIMERSLACK, 1, 0, 0, 0);
    uint8_t *block = malloc(BATCH_BYTES);
    int64_t *due_ns = malloc((size_t)number * sizeof *due_ns);
    int32_t fault = block && due_ns ? 0 : ENOMEM;
    for (int32_t at = 0; !fault && at < number; ++at)
        due_ns[at] = begin_ns + outs[at]->offset_ns;
    while (!fault && !stopped(stop)) {
        int32_t next = -1;
        for (int32_t at = 0; at < number; ++at)
            if (due_ns[at] != INT64_MAX && (next < 0 || due_ns[at] < due_ns[next]))
                next = at;
        if (next < 0)
            break;
        struct probe_out *out = outs[next];
        int64_t at_ns = now_ns();
        const int64_t spin_ns = out->rate_hz > 0 ? SPIN_NS : 0;
        if (due_ns[next] - at_ns > spin_ns) {
            const int64_t wake_ns = due_ns[next] - spin_ns;
            sleep_until(wake_ns - at_ns > WAIT_NS ? at_ns + WAIT_NS : wake_ns);
            continue;
        }
        if (due_ns[next] > at_ns)
            continue;
        const int64_t room = room_of(out, at_ns);
        fault = send_next(out, room, block);
        if (out->count ? out->done >= out->count : at_ns >= until_ns)
            due_ns[next] = INT64_MAX;
        else if (out->rate_hz > 0)
            due_ns[next] = due_of(out, begin_ns);
        else
            due_ns[next] = room ? at_ns : at_ns + LOOK_NS;
    }
    free(block);
    free(due_ns);
    return fault;
}

/* -- receiving ----------------------------------------------------------------------------------------------------- */

static int32_t arrived(struct probe_in *in, const uint8_t *bytes, size_t size, int64_t at_ns) {
    const uint8_t *place = place_of(bytes, size, &in->form);
    if (!place)
        return EBADMSG;
    const int64_t number = read_number(place, &in->form);
    if (in->forward) {
        probe_send_one(in->forward, number); /* a bridge outlives its peers */
        return 0;
    }
    if (number) {
        int64_t capacity = in->capacity;
        if (!room_for(&in->numbers, &capacity, in->done + 1) || !room_for(&in->times, &in->capacity, in->done + 1))
            return ENOMEM;
        in->numbers[in->done] = number;
        in->times[in->done] = at_ns;
        __atomic_store_n(&in->done, in->done + 1, __ATOMIC_RELEASE);
        if (in->progress)
            __atomic_store_n(in->progress, number, __ATOMIC_RELEASE);
    } else if (!in->knocked) {
        in->first = malloc(size);
        if (!in->first)
            return ENOMEM;
        memcpy(in->first, bytes, size);
        in->first_size = size;
        __atomic_store_n(&in->knocked, 1, __ATOMIC_RELEASE);
    }
    return 0;
}

static struct probe_in *of_device(struct probe_in **ins, int32_t number, const uint8_t *device) {
    for (int32_t at = 0; at < number; ++at)
        if (!memcmp(ins[at]->device, device, DEVICE_SIZE))
            return ins[at];
    return NULL;
}

/* Read a connection until its end.  Nothing is read while `pause` is 1.  Returns 0 or errno. */
int32_t probe_receive_link(int fd, struct probe_in **ins, int32_t number, const int32_t *pause) {
    size_t capacity = BUFFER_BYTES, begin = 0, filled = 0;
    uint8_t *buffer = malloc(capacity);
    int32_t fault = buffer ? 0 : ENOMEM;
    prctl(PR_SET_TIMERSLACK, 1, 0, 0, 0);
    while (!fault) {
        const ssize_t got = recv(fd, buffer + filled, capacity - filled, 0);
        if (got < 0 && errno == EINTR)
            continue;
        if (got <= 0)
            break; /* closed, by the other end or by us */
        const int64_t at_ns = now_ns();
        filled += (size_t)got;
        size_t size = HEADER_SIZE;
        while (!fault && filled - begin >= HEADER_SIZE) {
            uint64_t body;
            memcpy(&body, buffer + begin + BODY_SIZE_AT, 8);
            size = HEADER_SIZE + be64toh(body);
            if (size > filled - begin)
                break;
            struct probe_in *in = of_device(ins, number, buffer + begin + DEVICE_AT);
            if (in)
                fault = arrived(in, buffer + begin, size, at_ns);
            begin += size;
            size = HEADER_SIZE;
        }
        if (begin == filled) {
            begin = filled = 0;
        } else if (begin + size > capacity) {
            memmove(buffer, buffer + begin, filled - begin);
            filled -= begin;
            begin = 0;
            if (size > capacity) {
                capacity = 2 * size;
                uint8_t *grown = realloc(buffer, capacity);
                fault = grown ? 0 : ENOMEM;
                buffer = grown ? grown : buffer;
            }
        }
        while (stopped(pause))
            sleep_until(now_ns() + STALL_LOOK_NS);
    }
    free(buffer);
    return fault;
}

static void *allocate(size_t size, void *state) {
    (void)state;
    return malloc(size);
}

static void deallocate(void *pointer, void *state) {
    (void)state;
    free(pointer);
}

static void *reallocate(void *pointer, size_t size, void *state) {
    (void)state;
    return realloc(pointer, size);
}

static void *zero_allocate(size_t number, size_t size, void *state) {
    (void)state;
    return calloc(number, size);
}

static const struct rcl_allocator ALLOCATOR = {allocate, deallocate, reallocate, zero_allocate, NULL};

/* Wait on the subscriptions with a wait set, as rclcpp's executor does, and take what there is, until `stop` is 1.
 *
 * `guard` is an rcl_guard_condition_t that ends the wait then.  Returns 0 or the code of rcl or errno.
 */
int32_t probe_receive_ros(void *context, const void *guard, struct probe_in **ins, int32_t number, const int32_t *stop) {
    struct rcl_serialized message = {NULL, 0, 0, ALLOCATOR};
    struct rcl_message_info info;
    struct rcl_wait_set set = rcl.zero_wait_set();
    size_t index[MOST_TOPICS];
    if (number > MOST_TOPICS)
        return E2BIG;
    prctl(PR_SET_TIMERSLACK, 1, 0, 0, 0);
    int32_t fault = rcl.init(&set, (size_t)number, 1, 0, 0, 0, 0, context, ALLOCATOR);
    if (fault)
        return fault;
    while (!fault && !stopped(stop)) {
        fault = rcl.clear(&set);
        fault = fault ? fault : rcl.add_guard(&set, guard, NULL);
        for (int32_t at = 0; !fault && at < number; ++at)
            fault = rcl.add(&set, ins[at]->subscription, &index[at]);
        if (fault)
            break;
        fault = rcl.wait(&set, -1);
        for (int32_t at = 0; !fault && at < number; ++at) {
            if (!set.subscriptions[index[at]])
                continue;
            for (int turn = 0; !fault && turn < TAKE_AT_MOST; ++turn) {
                const int32_t taken = rcl.take(ins[at]->subscription, &message, &info, NULL);
                const int64_t at_ns = now_ns();
                if (taken == RCL_RET_SUBSCRIPTION_TAKE_FAILED)
                    break;
                fault = taken ? taken : arrived(ins[at], message.buffer, message.length, at_ns);
            }
        }
    }
    rcl.fini(&set);
    free(message.buffer);
    return fault;
}
