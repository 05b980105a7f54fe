/* Preloaded into a ROS 2 program that `igtl-gateway resim` runs: a middleware (rmw) whose time and messages come from a
 * recording, in place of the one that rcl would call.
 *
 * The coordinator (addons/resim) connects by a socket.  It sends inputs with their session time, and how far this program
 * may go; the library delivers one event at a time, whenever all threads of the program wait, and sends what the program
 * publishes.  Messages are (de)serialised by the functions of rmw_fastrtps_cpp, which need no participant: there is no
 * discovery, no thread and no socket of DDS in the process, so that nothing but the program decides what happens.
 *
 * Frames: size (uint32, of what follows), a letter, and fields without padding in the order of the machine; a string is a
 * uint16 and its bytes.  addons/resim/frames.py has the same table.
 *
 *   from the program                                            to the program
 *   H pid abi                                hello              W start_ns latency_ns wall_ns program clocks deadline_class  welcome
 *   E kind made id reliable latched all depth name type node d  M number t source subscription class name data  message
 *   O id t data                              published          q t service program client number data    request
 *   Q id number t data                       request            a t client number data                    response
 *   A id program client number t data        response           T id routed    how to publish
 *   X code text                              remark             N kind made name type    an entity elsewhere
 *   V id t number                            lost, queue full   D              drop the messages that are not delivered
 *   P now                                    still computing    R t class      run up to here
 *   I now next_t next_class number           idle               L t            it is t; look whether all are quiet
 *                                                               Z              the session is over
 */
#define _GNU_SOURCE
#include <dirent.h>
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <inttypes.h>
#include <limits.h>
#include <linux/futex.h>
#include <netinet/in.h>
#include <poll.h>
#include <pthread.h>
#include <semaphore.h>
#include <signal.h>
#include <spawn.h>
#include <stdarg.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/epoll.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <sys/random.h>
#include <sys/select.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/time.h>
#include <sys/timerfd.h>
#include <sys/un.h>
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>

#include "_abi.h"
#include "_time.h"

#define IDENTIFIER "rmw_fastrtps_cpp"
#define ABI_VERSION 3

enum { CLASS_MESSAGE = 1, CLASS_ALL = 9 }; /* inputs and deadlines are the classes 0 and 2; the welcome states which */
enum { SUBSCRIPTION = 's', PUBLISHER = 'p', SERVICE = 'v', CLIENT = 'c' };
enum { FLUSH_BYTES = 1 << 20, PROGRESS_BYTES = 64, FIRST_ROOM = 256 << 10 };
/* Real time after which the watching thread sends what the program has published, though it has not come to rest. */
#define LATE_NS 100000000LL
/* The end of a process waits this long, in real time, to send its last messages. */
#define REST_NS 500000000LL
/* Polls of a thread in a row that found nothing before the next one waits, and how long: a loop without a sleep. */
enum { POLLS = 20, POLL_NS = 1000000 };

struct message {
    struct message *next;
    int64_t t_ns;
    int64_t source_ns;
    uint64_t number; /* of a recorded input; of a request or response, its sequence number */
    uint32_t target; /* entity; 0: all subscriptions of the topic */
    uint32_t program, client;
    char letter; /* 'M', 'q', 'a' */
    char class_;
    int users;
    const char *topic; /* within the same block of memory, as data */
    uint8_t *data;
    size_t size;
    struct entity *local; /* the publisher of a message of this program */
};

struct queued {
    struct queued *next;
    struct message *message;
};

/* Frames that are not sent yet.  It is a file beside the socket, in which the coordinator finds what a program has published
 * that was killed or stopped, or has replaced itself by another one (addons/resim/link.py). */
struct outbox {
    _Atomic uint64_t sent;     /* bytes before those that are here */
    _Atomic uint64_t complete; /* bytes of complete frames here; 0 before `sent` grows by them */
    _Atomic int64_t now_ns;    /* session time */
    uint8_t data[];
};

struct node {
    struct abi_node handle;
    struct node *next;
    struct guard *graph;
    char *full_name;
};

struct guard {
    struct abi_guard handle;
    _Atomic int triggered;
};

struct entity {
    struct entity *next;
    int kind;
    uint32_t id;
    char *name, *type;
    struct node *node;
    const struct abi_message_type *message_type;
    const struct abi_service_type *service_type;
    struct abi_qos qos;
    bool ignores_local;
    struct queued *first, *last;
    size_t count;
    uint64_t since; /* order in which entities became ready */
    uint64_t taken;
    int64_t requests;
    int routed; /* publishers: 0 not known yet, 1 other programs receive it, 2 none does */
    uint64_t lost; /* messages that a full queue has dropped, and that are not reported yet; the first one's time */
    int64_t lost_ns;
    abi_callback callback;
    const void *user_data;
    pthread_mutex_t buffer_lock;
    struct abi_bytes buffer;
    uint64_t published;
};

struct elsewhere {
    struct elsewhere *next;
    int kind;
    int count;
    char *name, *type;
};

struct wait_set {
    struct abi_wait_set handle;
    uint64_t number;
};

/* Protected by T.lock. */
static struct {
    int socket;
    uint32_t program;
    int64_t latency_ns;
    struct entity *entities, *last_entity;
    struct elsewhere *elsewhere;
    struct node *nodes;
    uint32_t ids;
    uint64_t sets;
    uint64_t ready_count;
    size_t callbacks;
    bool has_lost;
    bool is_copy; /* a process that the program has forked: it has all of the program, and no part in the session */
    struct message *inbox, *last_inbox; /* from the coordinator, in order of time and class */
    struct message *own, *last_own;     /* published here, for subscriptions here */
    struct message *current;            /* is delivered to one subscription after the other */
    struct entity *current_at;
    uint64_t number; /* of the last recorded input that was delivered */
    int64_t limit_ns;
    int limit_class;
    int deadline_class;
    bool stop; /* ask the coordinator before the next event */
    bool look; /* the coordinator has sent something by a socket */
    _Atomic bool by_sockets; /* an OpenIGTLink program: it takes part from its first socket on */
    struct outbox *out;
    int out_file; /* -1: memory of this process alone */
    size_t out_size, out_room;
    uint8_t *in;
    size_t in_size, in_room, in_at;
} S = {.socket = -1, .out_file = -1};

static __thread struct {
    bool in_wait;       /* inside rcl_wait */
    int64_t timeout_ns; /* what the program asked for; rcl shortens it for its timers */
    bool has_waited;
    bool has_given; /* something is ready in this round: the timers wait for the next */
    int polls;
} own_wait = {.timeout_ns = -1};

static void join_session(void);
static void refuse_copy(const char *function);

/* -- functions of ROS -------------------------------------------------------------------------------------------- */

static void *ros_symbol(const char *name)
{
    static const char *const libraries[] = {"librmw_fastrtps_cpp.so", "librcl.so", "librcutils.so", "librmw.so",
                                            "librcl_logging_spdlog.so", "librcl_logging_noop.so"};
    for (size_t i = 0; i < sizeof libraries / sizeof *libraries; i++) {
        void *library = dlopen(libraries[i], RTLD_LAZY);
        void *found = library ? dlsym(library, name) : NULL;
        if (found)
            return found;
    }
    return NULL;
}

#define ROS(result, name, ...)                                                                                         \
    ({                                                                                                                 \
        static result (*found)(__VA_ARGS__);                                                                           \
        if (!found)                                                                                                    \
            found = (result(*)(__VA_ARGS__))ros_symbol(#name);                                                         \
        found;                                                                                                         \
    })

static void *allocate(size_t size, void *state)
{
    (void)state;
    return malloc(size);
}
static void deallocate(void *pointer, void *state)
{
    (void)state;
    free(pointer);
}
static void *reallocate(void *pointer, size_t size, void *state)
{
    (void)state;
    return realloc(pointer, size);
}
static void *zero_allocate(size_t count, size_t size, void *state)
{
    (void)state;
    return calloc(count, size);
}
static const struct abi_allocator *allocator(void)
{
    static const struct abi_allocator ours = {allocate, deallocate, reallocate, zero_allocate, NULL};
    return &ours;
}

static void failed(const char *text)
{
    void (*set)(const char *, const char *, size_t) =
        ROS(void, rcutils_set_error_state, const char *, const char *, size_t);
    if (set)
        set(text, "igtl-gateway resim", 0);
}

/* -- frames ------------------------------------------------------------------------------------------------------ */

static void give_up(const char *why)
{
    fprintf(stderr, "igtl-gateway resim: %s\n", why);
    kill(getpid(), SIGKILL);
}

/* All of it is sent. */
static void clear_out(void)
{
    if (!S.out_size)
        return;
    atomic_store(&S.out->complete, 0);
    atomic_fetch_add(&S.out->sent, S.out_size);
    S.out_size = 0;
}

static void flush(void)
{
    size_t at = 0;
    while (at < S.out_size) {
        ssize_t sent = send(S.socket, S.out->data + at, S.out_size - at, MSG_NOSIGNAL);
        if (sent > 0)
            at += (size_t)sent;
        else if (errno != EINTR)
            give_up("the connection with the session is closed, perhaps by the program");
    }
    clear_out();
}

/* Have room for this number of bytes. */
static void grow_out(size_t room)
{
    size_t head = sizeof *S.out;
    bool is_full = S.out_file >= 0 && posix_fallocate(S.out_file, 0, (off_t)(head + room));
    void *more = S.out ? mremap(S.out, head + S.out_room, head + room, MREMAP_MAYMOVE)
                       : mmap(NULL, head + room, PROT_READ | PROT_WRITE,
                              S.out_file < 0 ? MAP_PRIVATE | MAP_ANONYMOUS : MAP_SHARED, S.out_file, 0);
    if (is_full || more == MAP_FAILED)
        give_up(is_full ? "no space for what the program publishes" : "out of memory");
    S.out = more;
    S.out_room = room;
}

/* Store unsent frames in a file beside the socket; in memory if the file cannot be created. */
static void open_out(const char *path)
{
    char name[256];
    snprintf(name, sizeof name, "%s.%d.out", path, getpid());
    S.out_file = open(name, O_RDWR | O_CREAT | O_EXCL | O_CLOEXEC, 0600);
    if (S.out_file >= 0 && posix_fallocate(S.out_file, 0, FIRST_ROOM)) {
        close(S.out_file);
        S.out_file = -1;
    }
    grow_out(FIRST_ROOM);
}

static void put(const void *data, size_t size)
{
    if (S.out_size + size > S.out_room)
        grow_out(2 * (S.out_size + size));
    memcpy(S.out->data + S.out_size, data, size);
    S.out_size += size;
}

#define PUT(value)                                                                                                     \
    do {                                                                                                               \
        __typeof__(value) put_value = (value);                                                                         \
        put(&put_value, sizeof put_value);                                                                             \
    } while (0)

static void put_text(const char *text)
{
    size_t size = text ? strlen(text) : 0;
    if (size > UINT16_MAX)
        size = UINT16_MAX;
    PUT((uint16_t)size);
    put(text, size);
}

static size_t begin_frame(char letter)
{
    size_t at = S.out_size;
    PUT((uint32_t)0);
    PUT(letter);
    return at;
}
static void end_frame(size_t at)
{
    uint32_t size = (uint32_t)(S.out_size - at - sizeof size);
    memcpy(S.out->data + at, &size, sizeof size);
    atomic_store(&S.out->complete, S.out_size);
}

static void remark(char code, const char *text)
{
    size_t frame = begin_frame('X');
    PUT(code);
    put_text(text);
    end_frame(frame);
}

/* Report a thread whose wait ends by real time; under the lock. */
static void found_real_wait(pid_t tid, const char *call)
{
    char text[64], name[32] = "";
    snprintf(text, sizeof text, "/proc/self/task/%d/comm", tid);
    int file = open(text, O_RDONLY | O_CLOEXEC);
    ssize_t size = file < 0 ? 0 : read(file, name, sizeof name - 1);
    if (file >= 0)
        close(file);
    name[size > 0 ? size - 1 : 0] = 0; /* without the end of the line */
    snprintf(text, sizeof text, "%s %s", call, name);
    remark('w', text);
}

/* Report another process whose wait ends by real time, or one that keeps the program from its rest; under the lock. */
static void found_real_wait_of(pid_t process, const char *call)
{
    static pid_t told[64];
    char text[64];
    if (told[process % 64] == process)
        return;
    told[process % 64] = process;
    snprintf(text, sizeof text, "%d %s", process, call);
    remark('h', text);
}
static void found_other(pid_t process, bool is_computing)
{
    char text[16];
    snprintf(text, sizeof text, "%d", process);
    remark(is_computing ? 'c' : 'z', text);
}

/* The next frame; blocks.  Returns its bytes behind the size; they stay until the next call. */
static uint8_t *next_frame(uint32_t *size)
{
    for (;;) {
        size_t there = S.in_size - S.in_at;
        if (there >= sizeof *size) {
            memcpy(size, S.in + S.in_at, sizeof *size);
            if (there >= sizeof *size + *size) {
                uint8_t *frame = S.in + S.in_at + sizeof *size;
                S.in_at += sizeof *size + *size;
                return frame;
            }
        } else {
            *size = 0;
        }
        if (S.in_at) {
            memmove(S.in, S.in + S.in_at, there);
            S.in_size = there;
            S.in_at = 0;
        }
        size_t room = sizeof *size + *size > (256 << 10) ? sizeof *size + *size : 256 << 10;
        if (S.in_room < room) {
            uint8_t *more = realloc(S.in, room);
            if (!more)
                give_up("out of memory");
            S.in = more;
            S.in_room = room;
        }
        ssize_t got = recv(S.socket, S.in + S.in_size, S.in_room - S.in_size, 0);
        if (got > 0)
            S.in_size += (size_t)got;
        else if (got == 0 || errno != EINTR)
            give_up("the connection with the session is closed, perhaps by the program");
    }
}

#define GET(type)                                                                                                      \
    ({                                                                                                                 \
        type get_value;                                                                                                \
        memcpy(&get_value, frame, sizeof get_value);                                                                   \
        frame += sizeof get_value;                                                                                     \
        get_value;                                                                                                     \
    })

static char *get_text(uint8_t **at)
{
    uint8_t *frame = *at;
    size_t size = GET(uint16_t);
    char *text = strndup((char *)frame, size);
    *at = frame + size;
    return text;
}

/* -- messages ---------------------------------------------------------------------------------------------------- */

static struct message *new_message(char letter, const char *topic, size_t topic_size, const void *data, size_t size)
{
    struct message *message = calloc(1, sizeof *message + size + topic_size + 1);
    if (!message)
        give_up("out of memory");
    message->letter = letter;
    message->users = 1;
    message->data = (uint8_t *)(message + 1);
    message->size = size;
    memcpy(message->data, data, size);
    message->topic = (char *)message->data + size;
    memcpy(message->data + size, topic, topic_size);
    return message;
}

static void release(struct message *message)
{
    if (!--message->users)
        free(message);
}

static void append(struct message **first, struct message **last, struct message *message)
{
    message->next = NULL;
    if (*first)
        (*last)->next = message;
    else
        *first = message;
    *last = message;
}

static struct message *pop(struct message **first)
{
    struct message *message = *first;
    *first = message->next;
    return message;
}

static void enqueue(struct entity *entity, struct message *message)
{
    struct queued *queued = malloc(sizeof *queued);
    if (!queued)
        give_up("out of memory");
    *queued = (struct queued){NULL, message};
    message->users++;
    if (entity->first)
        entity->last->next = queued;
    else
        entity->first = queued, entity->since = ++S.ready_count;
    entity->last = queued;
    entity->count++;
    size_t depth = entity->qos.depth ? entity->qos.depth : 1;
    if (entity->qos.history != ABI_KEEP_ALL && entity->count > depth) {
        struct queued *oldest = entity->first;
        entity->first = oldest->next;
        entity->count--;
        release(oldest->message);
        free(oldest);
        if (!entity->lost++)
            entity->lost_ns = atomic_load(&T.now_ns);
        S.has_lost = true;
    }
}

static void report_lost(struct entity *entity)
{
    if (!entity->lost)
        return;
    size_t frame = begin_frame('V');
    PUT(entity->id);
    PUT(entity->lost_ns);
    PUT(entity->lost);
    end_frame(frame);
    entity->lost = 0;
}

/* The first message of an entity, which the caller releases; NULL without one.  Under the lock. */
static struct message *dequeue(struct entity *entity)
{
    struct queued *queued = entity->first;
    if (!queued)
        return NULL;
    struct message *message = queued->message;
    entity->first = queued->next;
    entity->count--;
    entity->since = ++S.ready_count;
    entity->taken++;
    free(queued);
    return message;
}

static void receive(uint8_t *frame, uint32_t size);

/* Report how far this program is, and wait until the coordinator lets it go on. */
static void exchange(void)
{
    int64_t next_ns = NEVER;
    int next_class = S.deadline_class;
    int64_t now = atomic_load(&T.now_ns);
    bool spins = false, has_unread = false;
    for (struct waiter *w = T.waiters; w; w = w->next) {
        if (w->deadline_ns < next_ns)
            next_ns = w->deadline_ns > now ? w->deadline_ns : now;
        spins |= w->kind == WAIT_ROS;
    }
    for (struct entity *entity = S.entities; entity; entity = entity->next)
        has_unread |= entity->kind == SUBSCRIPTION && entity->first;
    /* until when a callback sleeps that nothing goes on beside, or whose messages wait; and any other thread but the main one */
    int64_t callback_ns = 0, thread_ns = 0;
    for (struct waiter *w = T.waiters; w; w = w->next) {
        int64_t *latest = w->in_callback && (!spins || has_unread) ? &callback_ns : &thread_ns;
        if (w->kind != WAIT_ROS && (w->in_callback || w->tid != getpid()) && w->deadline_ns > *latest)
            *latest = w->deadline_ns;
    }
    if (S.own && S.own->t_ns <= next_ns) {
        next_ns = S.own->t_ns;
        next_class = CLASS_MESSAGE;
    }
    for (struct entity *entity = S.has_lost ? S.entities : NULL; entity; entity = entity->next)
        report_lost(entity);
    S.has_lost = false;
    size_t idle = begin_frame('I');
    PUT(now);
    PUT(next_ns);
    PUT((uint8_t)next_class);
    PUT(S.number);
    PUT(callback_ns);
    PUT(thread_ns);
    end_frame(idle);
    flush();
    S.stop = false;
    for (;;) {
        uint32_t left;
        uint8_t *frame = next_frame(&left);
        char letter = (char)*frame;
        receive(frame, left);
        if (letter == 'R' || letter == 'L' || letter == 'Z')
            return;
    }
}

/* Let session time go on. */
static void pass_to(int64_t t_ns)
{
    atomic_store(&T.now_ns, t_ns);
    atomic_store(&S.out->now_ns, t_ns);
}

static struct entity *entity_of(uint32_t id)
{
    struct entity *entity = S.entities;
    while (entity && entity->id != id)
        entity = entity->next;
    return entity;
}

static void trigger_graph(void)
{
    for (struct node *node = S.nodes; node; node = node->next)
        atomic_store(&node->graph->triggered, 1);
}

/* The session is over: the clocks are the real ones again, and all waits go on. */
static void end_session(void)
{
    atomic_store(&T.active, 0);
    for (struct waiter *w = T.waiters; w; w = w->next)
        if (!w->fired)
            fire(w);
}

static void receive(uint8_t *frame, uint32_t size)
{
    uint8_t *end = frame + size;
    char letter = GET(char);
    struct message *message;
    switch (letter) {
    case 'M': {
        uint64_t number = GET(uint64_t);
        int64_t t = GET(int64_t), source = GET(int64_t);
        uint32_t target = GET(uint32_t);
        uint8_t class_ = GET(uint8_t);
        size_t topic_size = GET(uint16_t);
        char *topic = (char *)frame;
        frame += topic_size;
        message = new_message('M', topic, topic_size, frame, (size_t)(end - frame));
        message->number = number, message->t_ns = t, message->source_ns = source;
        message->target = target, message->class_ = (char)class_;
        append(&S.inbox, &S.last_inbox, message);
        break;
    }
    case 'q':
    case 'a': {
        int64_t t = GET(int64_t);
        uint32_t target = GET(uint32_t), program = letter == 'q' ? GET(uint32_t) : 0;
        uint32_t client = letter == 'q' ? GET(uint32_t) : 0;
        int64_t number = GET(int64_t);
        message = new_message(letter, "", 0, frame, (size_t)(end - frame));
        message->t_ns = message->source_ns = t, message->target = target, message->class_ = CLASS_MESSAGE;
        message->program = program, message->client = client, message->number = (uint64_t)number;
        append(&S.inbox, &S.last_inbox, message);
        break;
    }
    case 'T': {
        struct entity *publisher = entity_of(GET(uint32_t));
        if (publisher)
            publisher->routed = GET(uint8_t);
        break;
    }
    case 'N': {
        int kind = GET(char), made = GET(uint8_t);
        char *name = get_text(&frame), *type = get_text(&frame);
        struct elsewhere **at = &S.elsewhere;
        while (*at && ((*at)->kind != kind || strcmp((*at)->name, name) || strcmp((*at)->type, type)))
            at = &(*at)->next;
        if (!*at) {
            *at = calloc(1, sizeof **at);
            if (!*at)
                give_up("out of memory");
            (*at)->kind = kind, (*at)->name = name, (*at)->type = type;
        } else {
            free(name);
            free(type);
        }
        (*at)->count += made ? 1 : -1;
        trigger_graph();
        break;
    }
    case 'D':
        while (S.inbox)
            release(pop(&S.inbox));
        break;
    case 'R':
        S.limit_ns = GET(int64_t);
        S.limit_class = GET(uint8_t);
        break;
    case 'L': {
        int64_t t = GET(int64_t);
        if (t > atomic_load(&T.now_ns))
            pass_to(t);
        S.look = true;
        break;
    }
    case 'Z':
        end_session();
        break;
    default:
        give_up("the coordinator sent an unknown frame");
    }
}

/* -- events ------------------------------------------------------------------------------------------------------ */

static bool is_spinning(void) { return T.waiters || S.callbacks || atomic_load(&S.by_sockets); }

static bool asks_for(const struct waiter *waiter, const void *entity)
{
    static const int lists[] = {0, 2, 3};
    for (size_t i = 0; i < 3; i++) {
        const struct abi_array *list = waiter->lists[lists[i]];
        for (size_t k = 0; list && k < list->count; k++)
            if (list->items[k] == entity)
                return true;
    }
    return false;
}

static bool has_triggered_guard(const struct waiter *waiter)
{
    const struct abi_array *list = waiter->lists[1];
    for (size_t k = 0; list && k < list->count; k++)
        if (list->items[k] && atomic_load(&((struct guard *)list->items[k])->triggered))
            return true;
    return false;
}

static bool give(struct entity *entity)
{
    struct waiter *chosen = NULL;
    for (struct waiter *w = T.waiters; w; w = w->next)
        if (w->kind == WAIT_ROS && !w->fired && (!chosen || w->order < chosen->order) && asks_for(w, entity))
            chosen = w;
    if (!chosen)
        return false;
    chosen->ready = entity;
    fire(chosen);
    return true;
}

/* What became ready before now: guard conditions, then entities in the order in which they did. */
static bool give_what_is_ready(void)
{
    struct waiter *chosen = NULL;
    for (struct waiter *w = T.waiters; w; w = w->next)
        if (w->kind == WAIT_ROS && !w->fired && (!chosen || w->order < chosen->order) && has_triggered_guard(w))
            chosen = w;
    if (chosen) {
        fire(chosen);
        return true;
    }
    uint64_t after = 0;
    for (;;) {
        struct entity *next = NULL;
        for (struct entity *entity = S.entities; entity; entity = entity->next)
            if (entity->first && entity->since > after && (!next || entity->since < next->since))
                next = entity;
        if (!next)
            return false;
        if (give(next))
            return true;
        after = next->since;
    }
}

static bool takes(const struct entity *entity, const struct message *message)
{
    if (message->letter != 'M')
        return entity->id == message->target;
    if (entity->kind != SUBSCRIPTION || strcmp(entity->name, message->topic))
        return false;
    if (message->target)
        return entity->id == message->target;
    const struct entity *from = message->local;
    if (!from)
        return true;
    return !entity->ignores_local && !strcmp(entity->type, from->type) &&
           !(entity->qos.reliability == ABI_RELIABLE && from->qos.reliability == ABI_BEST_EFFORT) &&
           !(entity->qos.durability == ABI_TRANSIENT_LOCAL && from->qos.durability == ABI_VOLATILE);
}

/* Deliver the current message to the next entity that takes it; whether something goes on by that. */
static bool deliver(void)
{
    while (S.current_at) {
        struct entity *entity = S.current_at;
        S.current_at = entity->next;
        if (!takes(entity, S.current))
            continue;
        enqueue(entity, S.current);
        if (entity->callback) {
            abi_callback callback = entity->callback;
            callback(entity->user_data, 1);
            call_watcher();
            return true;
        }
        if (give(entity))
            return true;
    }
    release(S.current);
    S.current = NULL;
    return false;
}

static struct waiter *first_deadline(void)
{
    struct waiter *first = NULL;
    for (struct waiter *w = T.waiters; w; w = w->next)
        if (w->deadline_ns != NEVER && !w->fired &&
            (!first || w->deadline_ns < first->deadline_ns ||
             (w->deadline_ns == first->deadline_ns && w->order < first->order)))
            first = w;
    return first;
}

/* Let the next event happen.  All threads are quiet; under the lock. */
static void step(void)
{
    while (atomic_load(&T.active)) {
        if (S.look) { /* something came by a socket: its threads run before the next event */
            S.look = false;
            call_watcher();
            return;
        }
        if (give_what_is_ready())
            return;
        if (S.current) {
            if (deliver())
                return;
            continue;
        }
        if (S.stop) {
            exchange();
            continue;
        }
        int64_t now = atomic_load(&T.now_ns), t = NEVER;
        int class_ = CLASS_ALL;
        struct message *message = S.inbox;
        if (message)
            t = message->t_ns, class_ = message->class_;
        bool is_own = S.own && S.own->t_ns <= S.limit_ns && (!message || S.own->t_ns < t ||
                                                            (S.own->t_ns == t && CLASS_MESSAGE < class_));
        if (is_own)
            message = S.own, t = message->t_ns, class_ = CLASS_MESSAGE;
        struct waiter *late = first_deadline();
        int64_t late_ns = late ? (late->deadline_ns > now ? late->deadline_ns : now) : NEVER;
        bool is_late = late && (late_ns < t || (late_ns == t && S.deadline_class < class_));
        if (is_late)
            t = late_ns, class_ = S.deadline_class;
        bool is_given = message && !is_own && !is_late; /* what the coordinator sent is within its limit */
        if ((!message && !is_late) ||
            (!is_given && (t > S.limit_ns || (t == S.limit_ns && class_ > S.limit_class)))) {
            exchange();
            continue;
        }
        if (t > now)
            pass_to(t);
        if (is_late) {
            late->timed_out = true;
            fire(late);
            return;
        }
        S.current = is_own ? pop(&S.own) : pop(&S.inbox);
        S.current_at = S.entities;
        if (S.current->class_ != CLASS_MESSAGE)
            S.number = S.current->number;
    }
}

/* -- the clocks of ROS ------------------------------------------------------------------------------------------- */

int32_t rcutils_system_time_now(int64_t *now)
{
    *now = atomic_load(&T.active) ? atomic_load(&T.now_ns) : real_ns(CLOCK_REALTIME);
    return ABI_OK;
}
int32_t rcutils_steady_time_now(int64_t *now)
{
    *now = atomic_load(&T.active) ? steady_ns() : real_ns(CLOCK_MONOTONIC);
    return ABI_OK;
}

/* -- the session ------------------------------------------------------------------------------------------------- */

/* The time that the program has reached, without asking for more; under the lock. */
static void report_progress(void)
{
    if (S.out_room - S.out_size < PROGRESS_BYTES) /* no more memory: the program may have crashed where it gets some */
        return;
    size_t frame = begin_frame('P');
    PUT((int64_t)atomic_load(&T.now_ns));
    end_frame(frame);
}

/* Of a program that computes for long, or hangs: what it has published, now and then; under the lock. */
static void send_late(void)
{
    static int64_t next_ns;
    int64_t now_ns = real_ns(CLOCK_MONOTONIC);
    if (now_ns < next_ns)
        return;
    next_ns = now_ns + LATE_NS;
    report_progress();
    report_others();
    flush();
}

/* Send the last messages at the end of the process.  Another thread may hold the lock for a short time, one that has crashed
 * until the end. */
__attribute__((destructor)) static void send_rest(void)
{
    struct timespec until = timespec_of(real_ns(CLOCK_REALTIME) + REST_NS);
    if (S.socket < 0 || pthread_mutex_timedlock(&T.lock, &until))
        return;
    report_progress();
    size_t at = 0;
    while (at < S.out_size) {
        ssize_t sent = send(S.socket, S.out->data + at, S.out_size - at, MSG_NOSIGNAL);
        if (sent <= 0)
            break;
        at += (size_t)sent;
    }
    clear_out();
    pthread_mutex_unlock(&T.lock);
}

/* The end without destructors. */
__attribute__((noreturn)) void _exit(int code)
{
    send_rest();
    NEXT(_exit)(code);
    __builtin_unreachable();
}
__attribute__((noreturn)) void _Exit(int code) { _exit(code); }

static void on_crash(int number)
{
    send_rest();
    signal(number, SIG_DFL);
    raise(number);
}

static void in_child(void)
{
    /* a copy of the process has no watching thread, and no part in the session */
    atomic_store(&T.active, 0);
    atomic_store(&T.entering, 0);
    pthread_mutex_t fresh = PTHREAD_MUTEX_INITIALIZER;
    memcpy(&T.lock, &fresh, sizeof fresh);
    T.waiters = NULL;
    S.is_copy = true;
    close(S.socket);
    S.socket = -1;
    S.out = NULL; /* it is that of the program */
    S.out_file = -1;
    S.out_size = S.out_room = 0;
}

/* A line in a file beside the socket, for the coordinator: `f`, a process that was started, which may run on in a session of
 * its own; `s`, one that has a socket of the network; `u`, a copy of the program that uses ROS, and how. */
static void note(char what, pid_t process, const char *text)
{
    char line[256];
    const char *place = getenv("IGTL_GATEWAY_RESIM");
    snprintf(line, sizeof line, "%s.notes", place ? place : "");
    int file = place ? open(line, O_WRONLY | O_APPEND | O_CREAT | O_CLOEXEC, 0600) : -1;
    if (file < 0)
        return;
    int size = snprintf(line, sizeof line, "%c %d %llu %s\n", what, process, stat_field(process, 22), text);
    if (write(file, line, (size_t)size) < 0)
        fprintf(stderr, "igtl-gateway resim: cannot note process %d\n", process);
    close(file);
}
static void notice(char code, const char *text)
{
    if (!atomic_load(&T.active))
        return;
    enter();
    remark(code, text);
    flush();
    leave();
}

static void has_started(pid_t child)
{
    atomic_fetch_add(&O.started, 1);
    note('f', child, "");
}

/* A copy cannot take part: its messages would be lost, and its waits never end. */
static void refuse_copy(const char *function)
{
    if (!S.is_copy)
        return;
    note('u', getpid(), function);
    give_up("a copy of the program uses ROS 2");
}

pid_t fork(void)
{
    pid_t child = NEXT(fork)();
    if (child > 0)
        has_started(child);
    return child;
}
/* What vfork permits, fork permits; a function that stands before vfork cannot return twice. */
pid_t vfork(void) { return fork(); }

int posix_spawn(pid_t *restrict child, const char *restrict path, const posix_spawn_file_actions_t *actions,
                const posix_spawnattr_t *restrict attributes, char *const arguments[restrict],
                char *const environment[restrict])
{
    pid_t started = 0;
    int code = NEXT(posix_spawn)(&started, path, actions, attributes, arguments, environment);
    if (!code)
        has_started(started);
    if (child)
        *child = started;
    return code;
}
int posix_spawnp(pid_t *restrict child, const char *restrict file, const posix_spawn_file_actions_t *actions,
                 const posix_spawnattr_t *restrict attributes, char *const arguments[restrict],
                 char *const environment[restrict])
{
    pid_t started = 0;
    int code = NEXT(posix_spawnp)(&started, file, actions, attributes, arguments, environment);
    if (!code)
        has_started(started);
    if (child)
        *child = started;
    return code;
}
FILE *popen(const char *command, const char *mode)
{
    FILE *file = NEXT(popen)(command, mode);
    atomic_fetch_add(&O.started, 1);
    return file;
}
int system(const char *command) { return REALLY(NEXT(system)(command)); }

/* Random numbers of the system: the same in every process, if resim looks for what makes runs differ. */
static bool fill_fixed(uint8_t *buffer, size_t size)
{
    static _Atomic uint64_t state = 1;
    static _Atomic int is_fixed = -1;
    if (is_fixed < 0)
        is_fixed = getenv("IGTL_GATEWAY_RESIM_RANDOM") != NULL;
    for (size_t i = 0; is_fixed && i < size; i++) {
        uint64_t next = atomic_fetch_add(&state, 0x9E3779B97F4A7C15) * 0xBF58476D1CE4E5B9;
        buffer[i] = (uint8_t)(next >> 56);
    }
    return is_fixed;
}
ssize_t getrandom(void *buffer, size_t size, unsigned flags)
{
    return fill_fixed(buffer, size) ? (ssize_t)size : NEXT(getrandom)(buffer, size, flags);
}
int getentropy(void *buffer, size_t size) { return fill_fixed(buffer, size) ? 0 : NEXT(getentropy)(buffer, size); }

/* Timers of the system, which run in real time: each that is set is reported once, at the start of the session if it was
 * set before. */
enum timer_call { CALL_SETITIMER, CALL_ALARM, CALL_UALARM, CALL_TIMER_SETTIME, CALL_TIMERFD_SETTIME, TIMER_CALLS };
static const char *const timer_calls[TIMER_CALLS] = {"setitimer", "alarm", "ualarm", "timer_settime", "timerfd_settime"};
static _Atomic bool timers_set[TIMER_CALLS];

static void sets_timer(enum timer_call call, bool is_set)
{
    if (is_set && !own_is_other && T.clocks != CLOCKS_REAL && !atomic_exchange(&timers_set[call], true))
        notice('t', timer_calls[call]);
}
static void report_early_timers(void)
{
    for (int call = 0; call < TIMER_CALLS; call++)
        if (atomic_load(&timers_set[call]) && T.clocks != CLOCKS_REAL)
            remark('t', timer_calls[call]);
}

int setitimer(__itimer_which_t which, const struct itimerval *restrict value, struct itimerval *restrict before)
{
    sets_timer(CALL_SETITIMER, value && (value->it_value.tv_sec || value->it_value.tv_usec));
    return NEXT(setitimer)(which, value, before);
}
unsigned alarm(unsigned seconds)
{
    sets_timer(CALL_ALARM, seconds);
    return NEXT(alarm)(seconds);
}
useconds_t ualarm(useconds_t value, useconds_t interval)
{
    sets_timer(CALL_UALARM, value);
    return NEXT(ualarm)(value, interval);
}
int timer_settime(timer_t timer, int flags, const struct itimerspec *restrict value, struct itimerspec *restrict before)
{
    sets_timer(CALL_TIMER_SETTIME, value && ns_of(&value->it_value));
    return NEXT(timer_settime)(timer, flags, value, before);
}
int timerfd_settime(int file, int flags, const struct itimerspec *value, struct itimerspec *before)
{
    sets_timer(CALL_TIMERFD_SETTIME, value && ns_of(&value->it_value));
    return NEXT(timerfd_settime)(file, flags, value, before);
}

/* A socket of the program's own: what comes by it, comes in real time. */
int socket(int domain, int type, int protocol)
{
    bool is_network = domain == AF_INET || domain == AF_INET6;
    if (is_network && getenv("IGTL_GATEWAY_RESIM_SOCKETS")) {
        atomic_store(&S.by_sockets, true);
        join_session();
    }
    int file = NEXT(socket)(domain, type, protocol);
    if (file >= 0 && is_network && (!atomic_load(&S.by_sockets) || (type & 15) == SOCK_DGRAM)) {
        notice('s', "");
        if (S.socket < 0)
            note('s', getpid(), "");
    }
    return file;
}

/* Where an OpenIGTLink program connects to, if not to the gateway's port. */
int connect(int file, const struct sockaddr *address, socklen_t size)
{
    const char *port = getenv("IGTL_PORT");
    bool is_network = address && size >= (socklen_t)sizeof(struct sockaddr_in) &&
                      (address->sa_family == AF_INET || address->sa_family == AF_INET6);
    if (is_network && atomic_load(&S.by_sockets) && port &&
        ntohs(((const struct sockaddr_in *)(const void *)address)->sin_port) != atoi(port)) /* at one place in both */
        notice('s', "");
    return NEXT(connect)(file, address, size);
}

/* Connect with the coordinator at the first context of the process; blocks until it has answered. */
static void join_session(void)
{
    static pthread_mutex_t once = PTHREAD_MUTEX_INITIALIZER;
    static bool has_joined;
    const char *path = getenv("IGTL_GATEWAY_RESIM");
    pthread_mutex_lock(&once);
    if (path && !has_joined) {
        has_joined = true;
        struct sockaddr_un address = {.sun_family = AF_UNIX};
        snprintf(address.sun_path, sizeof address.sun_path, "%s", path);
        S.socket = NEXT(socket)(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0);
        if (S.socket < 0 || connect(S.socket, (struct sockaddr *)&address, sizeof address))
            give_up("found no coordinator");
        open_out(path);
        size_t hello = begin_frame('H');
        PUT((uint32_t)getpid());
        PUT((uint32_t)ABI_VERSION);
        end_frame(hello);
        flush();
        find_launchers(S.socket);
        uint32_t size;
        uint8_t *frame = next_frame(&size);
        if (GET(char) != 'W')
            give_up("the coordinator sent no welcome");
        int64_t start_ns = GET(int64_t);
        S.latency_ns = GET(int64_t);
        int64_t wall_offset_ns = GET(int64_t);
        S.program = GET(uint32_t);
        int clocks = GET(uint8_t);
        S.deadline_class = GET(uint8_t);
        S.limit_ns = INT64_MIN;
        if (!start_time(start_ns, wall_offset_ns, clocks))
            give_up("cannot start session time");
        pthread_atfork(NULL, NULL, in_child);
        static const int crashes[] = {SIGSEGV, SIGBUS,  SIGFPE,  SIGILL, SIGABRT, SIGTRAP,
                                      SIGSYS,  SIGTERM, SIGHUP, SIGPIPE, SIGALRM};
        at_quick_exit(send_rest);
        for (size_t i = 0; i < sizeof crashes / sizeof *crashes; i++) {
            struct sigaction before;
            if (!sigaction(crashes[i], NULL, &before) && before.sa_handler == SIG_DFL)
                signal(crashes[i], on_crash);
        }
        S.stop = true;
        report_early_timers();
        atomic_store(&T.active, 1);
    }
    pthread_mutex_unlock(&once);
}

#include "_rmw.h"
