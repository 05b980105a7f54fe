/* Session time of a program: which threads wait, whether all are quiet, and the clocks and waits of libc.
 *
 * Included by _preload.c only.  A thread of the program waits in session time as a `struct waiter`: in rmw_wait, a sleep, or
 * a wait with a timeout.  Time passes only if the program is quiet: every other thread sleeps in the kernel, nothing has
 * woken it, and none is on its way into this library.  Then one event happens (`step` in _preload.c).
 *
 * Why "quiet" is sound: the CPU time of all threads is read, then the state of each, then the CPU times again.  If no
 * CPU time changed, no thread ran between the end of the first reading and the start of the second; if each state in
 * between is "sleeping", none was about to run; and a thread that does not run wakes no other.
 */
#ifndef IGTL_GATEWAY_PRELOAD_TIME_H
#define IGTL_GATEWAY_PRELOAD_TIME_H

#include "_others.h"

enum { CLOCKS_SESSION = 0, CLOCKS_REAL = 1 }; /* whether the clocks and waits of libc have session time */
enum { POLLS_A_NS = 10, MOST_POLLS = 10000, MOST_EPOLLS = 1000, POLL_WAIT_NS = 1000000 };
enum { MOST_OTHERS = 16, OWN_TIMED = 1024 };
enum wait_kind { WAIT_ROS, WAIT_SLEEP, WAIT_SIGNAL, WAIT_CONDITION };

#define NEVER INT64_MAX
/* Session time of steady clocks starts at 24 days, or at three years: above the uptime, so that the step from the real one
 * goes forward; and if possible so low that a nanosecond more is another float: a deadline of asyncio has to be later. */
#define STEADY_START_NS (2097152 * NS_PER_S)
#define LATE_STEADY_START_NS (100000000 * NS_PER_S)
/* Ends a semaphore's wait or a poll at its session time; programs do not use the last real-time signals but two. */
#define WAKE_SIGNAL (SIGRTMAX - 2)

struct wait_set_args {
    struct abi_array *lists[5]; /* subscriptions, guards, services, clients, events */
    void **items[5];            /* copies of what was asked for */
};

struct waiter {
    struct waiter *next;
    enum wait_kind kind;
    pid_t tid;
    _Atomic int word;    /* futex of WAIT_ROS and WAIT_SLEEP: 1 = go on */
    bool fired;          /* it was chosen, and is about to go on */
    bool in_callback;    /* its thread has come out of rmw_wait, and is not back in it */
    int64_t deadline_ns; /* session time; NEVER */
    uint64_t order;      /* among equal deadlines: wait sets by their creation, then threads by theirs */
    pthread_cond_t *condition;
    struct abi_array **lists;
    void *ready; /* WAIT_ROS: the entity that is ready; NULL: guard conditions, or the deadline */
    bool timed_out;
};

/* All of it is protected by `lock`, except for what is atomic. */
static struct {
    pthread_mutex_t lock;
    _Atomic int active;   /* session time is on */
    _Atomic int entering; /* threads inside this library that do not wait yet */
    _Atomic int watch;    /* futex: the watching thread has to look whether all are quiet */
    _Atomic int64_t now_ns;
    _Atomic int real_waits; /* threads in a sleep or timed wait of real time: they are not quiet */
    int64_t start_ns;
    int64_t steady_start_ns;
    int64_t wall_offset_ns; /* the wall clock of libc is later than session time by this */
    int clocks;
    struct waiter *waiters;
    pid_t watcher;
    sem_t is_watching;
    _Atomic pid_t others[MOST_OTHERS]; /* threads that are no part of the program; 0 = free */
    _Atomic pid_t own_timed[OWN_TIMED]; /* threads in waits of the interpreter, which are of real time, by their numbers */
    int task_folder;
    struct task {
        pid_t tid;
        int stat;
        clockid_t clock;
        int64_t cpu_ns;
        int64_t looked_ns; /* CPU time when its system call was read; -1 = never */
        bool is_held;      /* it waits for another process: for a lock, or a reader of what it prints; or it has just gone on */
        bool is_told;      /* its wait in real time has been reported */
        bool is_other; /* no thread of the program */
        bool skip;
        bool seen;
    } *tasks;
    size_t task_count;
    size_t task_room;
} T = {.lock = PTHREAD_MUTEX_INITIALIZER, .task_folder = -1};

static __thread pid_t own_tid;
static __thread uint64_t own_number;    /* by creation, from 1; 0: of the main thread */
static __thread bool own_is_other;      /* this thread is no part of the program */
static __thread int64_t own_polled_ns;  /* session time that the steady clock of this thread has reached by polls */
static __thread bool own_in_callback;   /* this thread has come out of rmw_wait: it calls callbacks, or loops */
static __thread bool own_starts_others; /* nor are those that it starts now */

static void step(void);
static void send_late(void);
static void found_real_wait(pid_t tid, const char *call);
static bool is_spinning(void); /* whether the program waits for events, so that time may pass */

static pid_t tid_of_this(void)
{
    if (!own_tid)
        own_tid = (pid_t)syscall(SYS_gettid);
    return own_tid;
}

/* glibc 2.35 and later have it. */
int epoll_pwait2(int file, struct epoll_event *events, int most, const struct timespec *timeout, const sigset_t *mask);

/* The functions that ours stand before, looked up when the library is loaded: later, a thread may wait for another one that
 * holds the loader's lock, as those of LTTng do.  GLIBC_2.3.2 is x86-64's version of the condition variables of today. */
#define REPLACED(row)                                                                                                  \
    row(clock_gettime) row(gettimeofday) row(clock_nanosleep) row(nanosleep) row(sem_timedwait) row(sem_clockwait)     \
    row(pthread_cond_timedwait) row(pthread_cond_clockwait) row(poll) row(epoll_wait) row(select) row(ppoll) row(epoll_pwait) row(epoll_pwait2) row(sigtimedwait) row(pselect) row(fork)            \
    row(posix_spawn) row(posix_spawnp) row(popen) row(system) row(socket) row(connect) row(setitimer) row(alarm) row(ualarm) row(timer_settime) row(timerfd_settime) row(pthread_create)       \
    row(sem_wait) row(getrandom) row(getentropy) row(_exit)
static struct {
#define MEMBER(name) __typeof__(&name) name##_;
    REPLACED(MEMBER)
} R;

__attribute__((constructor)) static void look_up(void)
{
#define LOOK_UP(name)                                                                                                  \
    if (!R.name##_) {                                                                                                  \
        void *found = strncmp(#name, "pthread_cond", 12) ? NULL : dlvsym(RTLD_NEXT, #name, "GLIBC_2.3.2");            \
        R.name##_ = (__typeof__(&name))(found ? found : dlsym(RTLD_NEXT, #name));                                      \
    }
    REPLACED(LOOK_UP)
}

#define NEXT(name)                                                                                                     \
    ({                                                                                                                 \
        if (!R.name##_) /* before the constructor, by that of another library */                                       \
            look_up();                                                                                                 \
        R.name##_;                                                                                                     \
    })

static int64_t real_ns(clockid_t clock)
{
    struct timespec now;
    NEXT(clock_gettime)(clock, &now);
    return ns_of(&now);
}

static void futex_wait(_Atomic int *word, int value, const struct timespec *timeout)
{
    syscall(SYS_futex, word, FUTEX_WAIT_PRIVATE, value, timeout, NULL, 0);
}
static void futex_wake(_Atomic int *word) { syscall(SYS_futex, word, FUTEX_WAKE_PRIVATE, INT32_MAX, NULL, NULL, 0); }

static void enter(void)
{
    atomic_fetch_add(&T.entering, 1);
    pthread_mutex_lock(&T.lock);
}
static void leave(void)
{
    pthread_mutex_unlock(&T.lock);
    atomic_fetch_sub(&T.entering, 1);
}

/* -- quiet ------------------------------------------------------------------------------------------------------- */

static bool list_tasks(void)
{
    struct linux_dirent {
        uint64_t inode;
        int64_t offset;
        uint16_t size;
        uint8_t type;
        char name[];
    };
    _Alignas(8) char buffer[8192];
    for (size_t i = 0; i < T.task_count; i++)
        T.tasks[i].seen = false;
    lseek(T.task_folder, 0, SEEK_SET);
    for (;;) {
        long size = syscall(SYS_getdents64, T.task_folder, buffer, sizeof buffer);
        if (size <= 0)
            break;
        for (long at = 0; at < size;) {
            struct linux_dirent *entry = (struct linux_dirent *)(buffer + at);
            at += entry->size;
            pid_t tid = (pid_t)strtol(entry->name, NULL, 10);
            if (tid <= 0)
                continue;
            size_t i = 0;
            while (i < T.task_count && T.tasks[i].tid != tid)
                i++;
            if (i < T.task_count) {
                T.tasks[i].seen = true;
                continue;
            }
            struct task *tasks = with_room(T.tasks, T.task_count, &T.task_room, sizeof *tasks);
            if (!tasks)
                return false;
            T.tasks = tasks;
            char path[64];
            snprintf(path, sizeof path, "/proc/self/task/%d/stat", tid);
            int stat = open(path, O_RDONLY | O_CLOEXEC);
            if (stat < 0)
                continue;
            /* the clock of a thread's CPU time, as glibc's pthread_getcpuclockid makes it */
            clockid_t clock = (clockid_t)((~(unsigned)tid << 3) | 6U);
            bool is_other = tid == T.watcher;
            for (size_t k = 0; k < MOST_OTHERS; k++)
                is_other |= atomic_load(&T.others[k]) == tid;
            T.tasks[T.task_count++] = (struct task){
                .tid = tid, .stat = stat, .clock = clock, .looked_ns = -1, .is_other = is_other, .seen = true};
        }
    }
    for (size_t i = T.task_count; i-- > 0;)
        if (!T.tasks[i].seen) {
            close(T.tasks[i].stat);
            memmove(&T.tasks[i], &T.tasks[i + 1], (--T.task_count - i) * sizeof *T.tasks);
        }
    return true;
}

/* Look which system call a thread sleeps in, if it has run since the last look. */
static void look_at_call(struct task *task)
{
    char path[64], text[256];
    if (task->looked_ns == task->cpu_ns)
        return;
    task->looked_ns = task->cpu_ns;
    task->is_held = false;
    snprintf(path, sizeof path, "/proc/self/task/%d/syscall", task->tid);
    read_path(path, text, sizeof text);
    long call;
    uint64_t arguments[6];
    if (!parse_call(text, &call, arguments)) {
        if (!strncmp(text, "running", 7)) { /* since its state was read */
            task->is_held = true;
            task->looked_ns = -1;
        }
        return;
    }
    task->is_held = call == SYS_flock || prints(call, arguments) ||
                    (call == SYS_fcntl && (arguments[1] == F_SETLKW || arguments[1] == F_OFD_SETLKW));
    const char *name = task->is_told || T.clocks == CLOCKS_REAL || atomic_load(&T.own_timed[task->tid % OWN_TIMED]) == task->tid
                           ? NULL
                           : timed_call(call, arguments);
    if (name) {
        task->is_told = true;
        found_real_wait(task->tid, name);
    }
}

/* Whether all threads sleep but the caller's and the watching one, and all of the other processes; under the lock. */
static bool is_quiet(int entering)
{
    struct stat folder;
    if (atomic_load(&T.entering) != entering || atomic_load(&T.real_waits))
        return false;
    if (fstat(T.task_folder, &folder) || (folder.st_nlink != T.task_count + 2 && !list_tasks()))
        return false;
    if (!begin_others())
        return false;
    bool all_skipped = !O.count;
    pid_t self = tid_of_this();
    for (size_t i = 0; i < T.task_count; i++) {
        struct task *task = &T.tasks[i];
        task->skip = task->tid == self || task->is_other;
        for (struct waiter *w = T.waiters; w && !task->skip; w = w->next)
            if (w->tid == task->tid) {
                if (w->fired)
                    return false;
                task->skip = w->kind == WAIT_ROS || w->kind == WAIT_SLEEP;
                break;
            }
        if (task->skip)
            continue;
        all_skipped = false;
        task->cpu_ns = cpu_ns_at(task->clock);
    }
    if (all_skipped)
        return true;
    for (size_t i = 0; i < T.task_count; i++) {
        if (T.tasks[i].skip)
            continue;
        char state = state_at(T.tasks[i].stat);
        if (!state)
            list_tasks();
        if (state != 'S')
            return false;
    }
    if (!others_sleep())
        return false;
    for (size_t i = 0; i < T.task_count; i++)
        if (!T.tasks[i].skip && cpu_ns_at(T.tasks[i].clock) != T.tasks[i].cpu_ns)
            return false;
    for (size_t i = 0; i < T.task_count; i++) {
        if (!T.tasks[i].skip)
            look_at_call(&T.tasks[i]);
        if (!T.tasks[i].skip && T.tasks[i].is_held)
            return false;
    }
    if (!others_rest(T.clocks != CLOCKS_REAL))
        return false;
    return atomic_load(&T.entering) == entering;
}

static void call_watcher(void)
{
    if (!atomic_exchange(&T.watch, 1))
        futex_wake(&T.watch);
}

/* A thread of ours: looks whether all are quiet when the last thread of the program that ran does not do it itself. */
static void *watch(void *nothing)
{
    const struct timespec seldom = {.tv_nsec = 5000000};
    (void)nothing;
    own_is_other = true;
    T.watcher = tid_of_this();
    prctl(PR_SET_NAME, "igtl-resim"); /* the coordinator leaves it out where it looks whether the program computes */
    sem_post(&T.is_watching);
    for (;;) {
        long delay_ns = 50000;
        futex_wait(&T.watch, 0, &seldom);
        do {
            if (atomic_load(&T.watch)) {
                struct timespec delay = {.tv_nsec = delay_ns};
                syscall(SYS_nanosleep, &delay, NULL);
                delay_ns = delay_ns < 5000000 ? delay_ns * 9 / 8 : delay_ns; /* late by an eighth of the wait */
            }
            if (!atomic_load(&T.active))
                break;
            if (pthread_mutex_trylock(&T.lock))
                continue;
            if (is_spinning() && is_quiet(0)) {
                atomic_store(&T.watch, 0);
                step();
            } else {
                send_late();
            }
            pthread_mutex_unlock(&T.lock);
        } while (atomic_load(&T.watch));
    }
    return NULL;
}

/* -- waits ------------------------------------------------------------------------------------------------------- */

/* By numbers of our own: those of the kernel begin anew at their limit, so that a younger thread may have a lower one. */
static uint64_t order_of_thread(void)
{
    if (!own_number && tid_of_this() != getpid()) /* made without pthread_create */
        own_number = ((uint64_t)1 << 32) + (uint64_t)tid_of_this();
    return (1ULL << 32) + own_number;
}

static void add_waiter(struct waiter *waiter)
{
    waiter->tid = tid_of_this();
    waiter->in_callback = own_in_callback && waiter->kind != WAIT_ROS;
    waiter->next = T.waiters;
    T.waiters = waiter;
}

static void remove_waiter(struct waiter *waiter)
{
    struct waiter **at = &T.waiters;
    while (*at && *at != waiter)
        at = &(*at)->next;
    if (*at)
        *at = waiter->next;
}

/* Let a waiter go on; under the lock. */
static void fire(struct waiter *waiter)
{
    waiter->fired = true;
    switch (waiter->kind) {
    case WAIT_ROS:
    case WAIT_SLEEP:
        atomic_store(&waiter->word, 1);
        if (waiter->tid != tid_of_this())
            futex_wake(&waiter->word);
        break;
    case WAIT_SIGNAL:
        syscall(SYS_tgkill, getpid(), waiter->tid, WAKE_SIGNAL);
        break;
    case WAIT_CONDITION: /* others that wait for it see a spurious wake-up, which POSIX allows */
        pthread_cond_broadcast(waiter->condition);
        break;
    }
    if (waiter->tid != tid_of_this())
        call_watcher();
}

struct beginning {
    void *(*run)(void *);
    void *argument;
    uint64_t number;
    bool is_other;
};

static void *begin_thread(void *given)
{
    struct beginning beginning = *(struct beginning *)given;
    free(given);
    own_number = beginning.number;
    own_is_other = beginning.is_other;
    for (size_t i = 0; own_is_other && i < MOST_OTHERS; i++) {
        pid_t empty = 0;
        if (atomic_compare_exchange_strong(&T.others[i], &empty, tid_of_this()))
            break;
    }
    return beginning.run(beginning.argument);
}

/* No part of the program are the threads of LTTng, which ROS has trace points for, and that which flushes the log. */
int pthread_create(pthread_t *restrict thread, const pthread_attr_t *restrict attributes, void *(*run)(void *),
                   void *restrict argument)
{
    static _Atomic uint64_t count;
    Dl_info info;
    struct beginning *beginning = malloc(sizeof *beginning);
    if (!beginning)
        return EAGAIN;
    bool is_other = own_starts_others ||
                    (dladdr((void *)(uintptr_t)run, &info) && info.dli_fname &&
                     (strstr(info.dli_fname, "/liblttng-ust") || strstr(info.dli_fname, "/liburcu")));
    *beginning = (struct beginning){run, argument, atomic_fetch_add(&count, 1) + 1, is_other};
    int code = NEXT(pthread_create)(thread, attributes, begin_thread, beginning);
    if (code)
        free(beginning);
    return code;
}

/* Wait until `step` has chosen this waiter, which is WAIT_ROS or WAIT_SLEEP. */
static void wait_for_turn(struct waiter *waiter)
{
    int code = errno;
    enter();
    add_waiter(waiter);
    while (!waiter->fired && atomic_load(&T.active)) {
        if (is_quiet(1)) {
            step();
            if (waiter->fired)
                break;
        } else {
            call_watcher();
        }
        leave();
        futex_wait(&waiter->word, 0, NULL);
        enter();
    }
    remove_waiter(waiter);
    leave();
    errno = code;
}

/* Sleep until a session time; false if session time has ended meanwhile. */
static bool sleep_until(int64_t deadline_ns)
{
    struct waiter waiter = {.kind = WAIT_SLEEP, .deadline_ns = deadline_ns, .order = order_of_thread()};
    wait_for_turn(&waiter);
    return waiter.fired && atomic_load(&T.active);
}

/* -- clocks ------------------------------------------------------------------------------------------------------ */

static bool is_wall(clockid_t clock) { return clock == CLOCK_REALTIME || clock == CLOCK_REALTIME_COARSE; }
static bool is_steady(clockid_t clock)
{
    return clock == CLOCK_MONOTONIC || clock == CLOCK_MONOTONIC_COARSE || clock == CLOCK_MONOTONIC_RAW ||
           clock == CLOCK_BOOTTIME;
}
static int64_t wall_ns(void) { return atomic_load(&T.now_ns) + T.wall_offset_ns; }
static int64_t steady_ns(void) { return atomic_load(&T.now_ns) - T.start_ns + T.steady_start_ns; }

/* Whether the program reads session time from a clock of libc. */
static bool is_session(clockid_t clock)
{
    return atomic_load_explicit(&T.active, memory_order_relaxed) && T.clocks != CLOCKS_REAL && !own_is_other &&
           (is_steady(clock) || is_wall(clock));
}

/* What the program reads from a clock, ns. */
static int64_t read_clock(clockid_t clock)
{
    if (!is_session(clock))
        return real_ns(clock);
    int64_t ahead_ns = own_polled_ns - atomic_load(&T.now_ns);
    return is_steady(clock) ? steady_ns() + (ahead_ns > 0 ? ahead_ns : 0) : wall_ns();
}

/* Session time of a deadline on a clock. */
static int64_t deadline_of(clockid_t clock, const struct timespec *until)
{
    int64_t left = ns_of(until) - read_clock(clock), now = atomic_load(&T.now_ns);
    if (left <= 0)
        return now;
    return left > NEVER - now ? NEVER : now + left;
}

/* The same deadline for the real clock. */
static struct timespec real_deadline(clockid_t clock, const struct timespec *until)
{
    return timespec_of(real_ns(clock) + (ns_of(until) - read_clock(clock)));
}

int clock_gettime(clockid_t clock, struct timespec *time)
{
    if (!is_session(clock))
        return NEXT(clock_gettime)(clock, time);
    *time = timespec_of(read_clock(clock));
    return 0;
}

int gettimeofday(struct timeval *restrict time, void *restrict zone)
{
    if (!is_session(CLOCK_REALTIME))
        return NEXT(gettimeofday)(time, zone);
    int64_t now = wall_ns();
    *time = (struct timeval){.tv_sec = (time_t)(now / NS_PER_S), .tv_usec = (suseconds_t)(now % NS_PER_S / 1000)};
    return 0;
}

time_t time(time_t *result)
{
    time_t seconds = (time_t)(read_clock(CLOCK_REALTIME) / NS_PER_S);
    if (result)
        *result = seconds;
    return seconds;
}

/* -- sleeps ------------------------------------------------------------------------------------------------------ */

/* Whether this thread sleeps and waits in session time. */
static bool is_on(void)
{
    return atomic_load_explicit(&T.active, memory_order_relaxed) && T.clocks != CLOCKS_REAL && !own_is_other;
}

/* A sleep or a timed wait in real time. */
#define REALLY(call)                                                                                                   \
    ({                                                                                                                 \
        int counts = !own_is_other;                                                                                    \
        atomic_fetch_add(&T.real_waits, counts);                                                                       \
        __typeof__(call) really = (call);                                                                              \
        atomic_fetch_sub(&T.real_waits, counts);                                                                       \
        really;                                                                                                        \
    })

int clock_nanosleep(clockid_t clock, int flags, const struct timespec *request, struct timespec *rest)
{
    if (!is_on() || !(is_wall(clock) || is_steady(clock)))
        return REALLY(NEXT(clock_nanosleep)(clock, flags, request, rest));
    int64_t now = atomic_load(&T.now_ns);
    sleep_until(flags & TIMER_ABSTIME ? deadline_of(clock, request) : now + ns_of(request));
    return 0;
}

int nanosleep(const struct timespec *request, struct timespec *rest)
{
    if (!is_on())
        return REALLY(NEXT(nanosleep)(request, rest));
    sleep_until(atomic_load(&T.now_ns) + ns_of(request));
    return 0;
}

int usleep(useconds_t microseconds)
{
    struct timespec request = timespec_of((int64_t)microseconds * 1000);
    return nanosleep(&request, NULL);
}

unsigned sleep(unsigned seconds)
{
    struct timespec request = {.tv_sec = seconds};
    return nanosleep(&request, NULL) ? seconds : 0;
}

/* -- waits with a timeout ---------------------------------------------------------------------------------------- */

static void begin_timed(struct waiter *waiter, enum wait_kind kind, int64_t deadline_ns, pthread_cond_t *condition)
{
    *waiter = (struct waiter){
        .kind = kind, .deadline_ns = deadline_ns, .order = order_of_thread(), .condition = condition};
    if (kind == WAIT_SIGNAL) {
        sigset_t own;
        sigemptyset(&own);
        sigaddset(&own, WAKE_SIGNAL);
        pthread_sigmask(SIG_UNBLOCK, &own, NULL);
    }
    enter();
    add_waiter(waiter);
    leave();
    call_watcher();
}

/* Whether the wait ended by its deadline. */
static bool end_timed(struct waiter *waiter)
{
    int code = errno;
    enter();
    remove_waiter(waiter);
    leave();
    errno = code;
    return waiter->fired;
}

/* Of a thread that is about to wait for a semaphore: if it is the last one that runs, the next event happens.  Whether it
 * got the semaphore instead. */
static bool last_before(sem_t *semaphore)
{
    int code = errno;
    bool has_got = false;
    enter();
    if (is_spinning() && is_quiet(1)) {
        has_got = !sem_trywait(semaphore); /* all others sleep: nobody posts it now */
        if (!has_got)
            step();
    }
    leave();
    errno = code;
    return has_got;
}

int sem_wait(sem_t *semaphore)
{
    if (is_on() && (!sem_trywait(semaphore) || last_before(semaphore)))
        return 0;
    return NEXT(sem_wait)(semaphore);
}

static int wait_semaphore(sem_t *semaphore, int64_t deadline_ns)
{
    if (!sem_trywait(semaphore))
        return 0;
    if (deadline_ns <= atomic_load(&T.now_ns)) {
        errno = ETIMEDOUT;
        return -1;
    }
    struct waiter waiter;
    begin_timed(&waiter, WAIT_SIGNAL, deadline_ns, NULL);
    int result = NEXT(sem_wait)(semaphore), code = errno;
    bool is_late = end_timed(&waiter);
    if (!result)
        return 0;
    errno = is_late && code == EINTR ? ETIMEDOUT : code;
    return -1;
}

int sem_timedwait(sem_t *restrict semaphore, const struct timespec *restrict until)
{
    if (!is_on())
        return REALLY(NEXT(sem_timedwait)(semaphore, until));
    return wait_semaphore(semaphore, deadline_of(CLOCK_REALTIME, until));
}

int sem_clockwait(sem_t *restrict semaphore, clockid_t clock, const struct timespec *restrict until)
{
    if (!is_on())
        return REALLY(NEXT(sem_clockwait)(semaphore, clock, until));
    return wait_semaphore(semaphore, deadline_of(clock, until));
}

/* Whether the interpreter itself waits, for its lock: that is a matter of real time, every 5 ms. */
static bool is_interpreter(const void *caller)
{
    static _Atomic uintptr_t known[64]; /* twice the caller, and 1 for the interpreter: one word, so never half of it */
    uintptr_t place = (uintptr_t)caller, before = atomic_load(&known[(place >> 2) % 64]);
    if (before >> 1 == place)
        return before & 1;
    Dl_info info;
    bool found = false;
    if (dladdr(caller, &info) && info.dli_fname) {
        const char *file = strrchr(info.dli_fname, '/');
        file = file ? file + 1 : info.dli_fname;
        found = !strncmp(file, "libpython", 9) || !strncmp(file, "python", 6);
    }
    atomic_store(&known[(place >> 2) % 64], place << 1 | found);
    return found;
}

/* A wait of the interpreter, which is no part of what the program does. */
#define BY_INTERPRETER(call)                                                                                           \
    ({                                                                                                                 \
        _Atomic pid_t *own = &T.own_timed[tid_of_this() % OWN_TIMED];                                                  \
        atomic_store(own, own_tid);                                                                                    \
        int result = (call);                                                                                           \
        atomic_store(own, 0);                                                                                          \
        result;                                                                                                        \
    })

static int wait_condition(pthread_cond_t *condition, pthread_mutex_t *mutex, clockid_t clock,
                          const struct timespec *until)
{
    int64_t deadline_ns = deadline_of(clock, until);
    if (deadline_ns <= atomic_load(&T.now_ns))
        return ETIMEDOUT;
    struct waiter waiter;
    begin_timed(&waiter, WAIT_CONDITION, deadline_ns, condition);
    int result = pthread_cond_wait(condition, mutex);
    return end_timed(&waiter) && !result ? ETIMEDOUT : result;
}

int pthread_cond_timedwait(pthread_cond_t *restrict condition, pthread_mutex_t *restrict mutex,
                           const struct timespec *restrict until)
{
    clockid_t clock = condition->__data.__wrefs & 2 ? CLOCK_MONOTONIC : CLOCK_REALTIME; /* as glibc keeps it */
    if (is_interpreter(__builtin_return_address(0))) {
        struct timespec real = real_deadline(clock, until);
        return BY_INTERPRETER(NEXT(pthread_cond_timedwait)(condition, mutex, &real));
    }
    if (!is_on())
        return REALLY(NEXT(pthread_cond_timedwait)(condition, mutex, until));
    return wait_condition(condition, mutex, clock, until);
}

int pthread_cond_clockwait(pthread_cond_t *restrict condition, pthread_mutex_t *restrict mutex, clockid_t clock,
                           const struct timespec *restrict until)
{
    if (is_interpreter(__builtin_return_address(0))) {
        struct timespec real = real_deadline(clock, until);
        return BY_INTERPRETER(NEXT(pthread_cond_clockwait)(condition, mutex, clock, &real));
    }
    if (!is_on())
        return REALLY(NEXT(pthread_cond_clockwait)(condition, mutex, clock, until));
    return wait_condition(condition, mutex, clock, until);
}

/* Poll without a timeout, until something is ready, a signal of others comes, or the session time of the deadline. */
#define POLLED(call, left_ns)                                                                                          \
    ({                                                                                                                 \
        struct waiter waiter;                                                                                          \
        begin_timed(&waiter, WAIT_SIGNAL, atomic_load(&T.now_ns) + (left_ns), NULL);                                   \
        int polled = (call);                                                                                           \
        if (end_timed(&waiter) && polled < 0 && errno == EINTR)                                                        \
            polled = 0;                                                                                                \
        polled;                                                                                                        \
    })

/* How often a thread has polled at one time, and found nothing. */
static int fruitless_polls(int found)
{
    static __thread int64_t at_ns;
    static __thread int count;
    int64_t now = atomic_load(&T.now_ns);
    count = found || at_ns != now || !is_on() ? 0 : count + 1;
    at_ns = now;
    return count;
}

/* Python's pipes poll until their clock has passed the time of the first poll: so it passes for this thread alone, since
 * others might do something meanwhile. */
static int poll_at_once(struct pollfd *files, nfds_t count)
{
    int found = NEXT(poll)(files, count, 0), polls = fruitless_polls(found);
    int64_t now = atomic_load(&T.now_ns);
    if (polls && polls % POLLS_A_NS == 0)
        own_polled_ns = (own_polled_ns > now ? own_polled_ns : now) + 1;
    return polls && polls % MOST_POLLS == 0 ? POLLED(NEXT(poll)(files, count, -1), POLL_WAIT_NS) : found;
}

int poll(struct pollfd *files, nfds_t count, int timeout_ms)
{
    if (!timeout_ms)
        return poll_at_once(files, count);
    if (timeout_ms < 0)
        return NEXT(poll)(files, count, timeout_ms);
    if (!is_on())
        return REALLY(NEXT(poll)(files, count, timeout_ms));
    return POLLED(NEXT(poll)(files, count, -1), (int64_t)timeout_ms * 1000000);
}

/* Loops of events expect that time passes at last. */
static int epoll_at_once(int file, struct epoll_event *events, int most)
{
    int found = NEXT(epoll_wait)(file, events, most, 0), polls = fruitless_polls(found);
    return polls && polls % MOST_EPOLLS == 0 ? POLLED(NEXT(epoll_wait)(file, events, most, -1), POLL_WAIT_NS) : found;
}

int epoll_wait(int file, struct epoll_event *events, int most, int timeout_ms)
{
    if (!timeout_ms)
        return epoll_at_once(file, events, most);
    if (timeout_ms < 0)
        return NEXT(epoll_wait)(file, events, most, timeout_ms);
    if (!is_on())
        return REALLY(NEXT(epoll_wait)(file, events, most, timeout_ms));
    return POLLED(NEXT(epoll_wait)(file, events, most, -1), (int64_t)timeout_ms * 1000000);
}

static void clear_sets(int count, fd_set *readable, fd_set *writable, fd_set *failed)
{
    fd_set *const sets[] = {readable, writable, failed};
    for (int i = 0; i < 3; i++)
        if (sets[i])
            memset(sets[i], 0, (size_t)(count + 63) / 64 * 8);
}

int select(int count, fd_set *restrict readable, fd_set *restrict writable, fd_set *restrict failed,
           struct timeval *restrict timeout)
{
    int64_t left_ns = timeout ? (int64_t)timeout->tv_sec * NS_PER_S + (int64_t)timeout->tv_usec * 1000 : 0;
    if (left_ns <= 0)
        return NEXT(select)(count, readable, writable, failed, timeout);
    if (!is_on())
        return REALLY(NEXT(select)(count, readable, writable, failed, timeout));
    if (!count && !readable && !writable && !failed) { /* a sleep of old programs */
        sleep_until(atomic_load(&T.now_ns) + left_ns);
        return 0;
    }
    int result = POLLED(NEXT(select)(count, readable, writable, failed, NULL), left_ns);
    if (!result)
        clear_sets(count, readable, writable, failed);
    return result;
}

/* A signal mask that lets the signal of a deadline through. */
static const sigset_t *open_mask(const sigset_t *mask, sigset_t *copy)
{
    if (!mask)
        return NULL;
    *copy = *mask;
    sigdelset(copy, WAKE_SIGNAL);
    return copy;
}

int ppoll(struct pollfd *files, nfds_t count, const struct timespec *timeout, const sigset_t *mask)
{
    if (!timeout || ns_of(timeout) <= 0)
        return NEXT(ppoll)(files, count, timeout, mask);
    if (!is_on())
        return REALLY(NEXT(ppoll)(files, count, timeout, mask));
    sigset_t copy;
    return POLLED(NEXT(ppoll)(files, count, NULL, open_mask(mask, &copy)), ns_of(timeout));
}

int epoll_pwait(int file, struct epoll_event *events, int most, int timeout_ms, const sigset_t *mask)
{
    if (timeout_ms <= 0)
        return NEXT(epoll_pwait)(file, events, most, timeout_ms, mask);
    if (!is_on())
        return REALLY(NEXT(epoll_pwait)(file, events, most, timeout_ms, mask));
    sigset_t copy;
    return POLLED(NEXT(epoll_pwait)(file, events, most, -1, open_mask(mask, &copy)), (int64_t)timeout_ms * 1000000);
}

int epoll_pwait2(int file, struct epoll_event *events, int most, const struct timespec *timeout, const sigset_t *mask)
{
    if (!timeout || ns_of(timeout) <= 0)
        return NEXT(epoll_pwait2)(file, events, most, timeout, mask);
    if (!is_on())
        return REALLY(NEXT(epoll_pwait2)(file, events, most, timeout, mask));
    sigset_t copy;
    return POLLED(NEXT(epoll_pwait2)(file, events, most, NULL, open_mask(mask, &copy)), ns_of(timeout));
}

int sigtimedwait(const sigset_t *restrict set, siginfo_t *restrict info, const struct timespec *restrict timeout)
{
    if (!timeout || ns_of(timeout) <= 0)
        return NEXT(sigtimedwait)(set, info, timeout);
    if (!is_on())
        return REALLY(NEXT(sigtimedwait)(set, info, timeout));
    sigset_t copy;
    int number = POLLED(NEXT(sigtimedwait)(open_mask(set, &copy), info, NULL), ns_of(timeout));
    if (number)
        return number;
    errno = EAGAIN;
    return -1;
}

int pselect(int count, fd_set *restrict readable, fd_set *restrict writable, fd_set *restrict failed,
            const struct timespec *restrict timeout, const sigset_t *restrict mask)
{
    if (!timeout || ns_of(timeout) <= 0)
        return NEXT(pselect)(count, readable, writable, failed, timeout, mask);
    if (!is_on())
        return REALLY(NEXT(pselect)(count, readable, writable, failed, timeout, mask));
    sigset_t copy;
    int result = POLLED(NEXT(pselect)(count, readable, writable, failed, NULL, open_mask(mask, &copy)), ns_of(timeout));
    if (!result)
        clear_sets(count, readable, writable, failed);
    return result;
}

static void on_wake_signal(int number) { (void)number; }

/* Start the watching thread; once. */
static bool start_time(int64_t start_ns, int64_t wall_offset_ns, int clocks)
{
    pthread_t thread;
    sigset_t all, before;
    struct sigaction action = {.sa_handler = on_wake_signal}; /* without SA_RESTART: waits end with EINTR */
    T.start_ns = start_ns;
    T.steady_start_ns = real_ns(CLOCK_MONOTONIC) < STEADY_START_NS ? STEADY_START_NS : LATE_STEADY_START_NS;
    T.wall_offset_ns = wall_offset_ns;
    T.clocks = clocks;
    atomic_store(&T.now_ns, start_ns);
    T.task_folder = open("/proc/self/task", O_RDONLY | O_DIRECTORY | O_CLOEXEC);
    if (T.task_folder < 0 || sigaction(WAKE_SIGNAL, &action, NULL))
        return false;
    sigfillset(&all);
    pthread_sigmask(SIG_SETMASK, &all, &before);
    sem_init(&T.is_watching, 0, 0);
    bool is_started = !NEXT(pthread_create)(&thread, NULL, watch, NULL);
    while (is_started && NEXT(sem_wait)(&T.is_watching)) {
    }
    pthread_sigmask(SIG_SETMASK, &before, NULL);
    if (!is_started)
        return false;
    pthread_detach(thread);
    return true;
}

#endif
