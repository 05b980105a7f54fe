/* What the kernel shows of threads and processes: CPU time, state, and the system call in which one sleeps.
 *
 * It has no state, so that _time.h asks it about this process, and _others.h about the others.
 */
#ifndef IGTL_GATEWAY_PRELOAD_PROC_H
#define IGTL_GATEWAY_PRELOAD_PROC_H

#define NS_PER_S 1000000000LL

static int64_t ns_of(const struct timespec *time) { return (int64_t)time->tv_sec * NS_PER_S + time->tv_nsec; }
static struct timespec timespec_of(int64_t ns)
{
    return (struct timespec){.tv_sec = (time_t)(ns / NS_PER_S), .tv_nsec = (long)(ns % NS_PER_S)};
}

/* CPU time of a thread or a process, by its clock; -1 if it has ended. */
static int64_t cpu_ns_at(clockid_t clock)
{
    struct timespec time;
    return syscall(SYS_clock_gettime, clock, &time) ? -1 : ns_of(&time);
}

/* The line of a file of /proc; "" if it cannot be read. */
static void read_path(const char *path, char *text, size_t room)
{
    int file = open(path, O_RDONLY | O_CLOEXEC);
    ssize_t size = file < 0 ? 0 : read(file, text, room - 1);
    if (file >= 0)
        close(file);
    text[size > 0 ? size : 0] = 0;
}

/* A list with room for one more item; NULL if there is no memory. */
static void *with_room(void *items, size_t count, size_t *room, size_t size)
{
    size_t more = *room ? 2 * *room : 32;
    if (count < *room)
        return items;
    void *grown = realloc(items, more * size);
    if (grown)
        *room = more;
    return grown;
}

/* State of a thread, whose `stat` is open: a letter of the kernel, 0 if it has ended. */
static char state_at(int stat)
{
    char text[128];
    ssize_t size = pread(stat, text, sizeof text - 1, 0);
    if (size <= 0)
        return 0;
    text[size] = 0;
    char *end = strrchr(text, ')');
    return end && end[1] ? end[2] : 0;
}

/* System calls that end after a time which this library does not know: of the argument with that number (from 0), the
 * first bit is what counts.  Threads come to them by the functions that are not replaced here, or by syscall(). */
static const struct {
    long call;
    const char *name;
    int argument; /* -1: always; else a pointer that is not NULL, or milliseconds above 0 */
    bool is_ms;
} timed_calls[] = {
    {SYS_clock_nanosleep, "clock_nanosleep", -1, false},
    {SYS_ppoll, "ppoll", 2, false},
    {SYS_pselect6, "pselect6", 4, false},
    {SYS_epoll_pwait, "epoll_pwait", 3, true},
    {SYS_rt_sigtimedwait, "rt_sigtimedwait", 2, false},
    {SYS_mq_timedsend, "mq_timedsend", 4, false},
    {SYS_mq_timedreceive, "mq_timedreceive", 4, false},
    {SYS_semtimedop, "semtimedop", 3, false},
    {SYS_recvmmsg, "recvmmsg", 4, false},
    {SYS_io_getevents, "io_getevents", 4, false},
    {SYS_nanosleep, "nanosleep", -1, false},
#ifdef SYS_epoll_pwait2
    {SYS_epoll_pwait2, "epoll_pwait2", 3, false},
#endif
#ifdef SYS_futex_waitv
    {SYS_futex_waitv, "futex_waitv", 3, false},
#endif
#ifdef SYS_poll /* not on all machines */
    {SYS_poll, "poll", 2, true},
    {SYS_select, "select", 4, false},
    {SYS_epoll_wait, "epoll_wait", 3, true},
#endif
};

/* The name of the call with a time limit in which a thread sleeps; NULL for none. */
static const char *timed_call(long call, const uint64_t *arguments)
{
    if (call == SYS_futex) {
        uint64_t operation = arguments[1] & (uint64_t)FUTEX_CMD_MASK;
        bool is_wait = operation == FUTEX_WAIT || operation == FUTEX_WAIT_BITSET || operation == FUTEX_LOCK_PI;
        return is_wait && arguments[3] ? "futex" : NULL;
    }
    for (size_t i = 0; i < sizeof timed_calls / sizeof *timed_calls; i++)
        if (timed_calls[i].call == call) {
            int at = timed_calls[i].argument;
            bool has_limit = at < 0 || (timed_calls[i].is_ms ? (int32_t)arguments[at] > 0 : arguments[at] != 0);
            return has_limit ? timed_calls[i].name : NULL;
        }
    return NULL;
}

/* Whether a call with a time limit waits for nothing else. */
static bool is_sleep(long call, const uint64_t *arguments)
{
    bool is_wait_for_none = call == SYS_ppoll && !arguments[1];
    is_wait_for_none |= call == SYS_pselect6 && !arguments[0];
#ifdef SYS_poll
    is_wait_for_none |= (call == SYS_poll && !arguments[1]) || (call == SYS_select && !arguments[0]);
#endif
    return is_wait_for_none || call == SYS_clock_nanosleep || call == SYS_nanosleep;
}

/* Parse a line of /proc/PID/syscall; false if the thread runs, or the line cannot be read. */
static bool parse_call(const char *text, long *call, uint64_t *arguments)
{
    return sscanf(text, "%ld %" SCNx64 " %" SCNx64 " %" SCNx64 " %" SCNx64 " %" SCNx64 " %" SCNx64, call, &arguments[0],
                  &arguments[1], &arguments[2], &arguments[3], &arguments[4], &arguments[5]) == 7;
}

/* Whether a call writes to a pipe or a terminal, which is full: the program goes on as soon as it is read. */
static bool prints(long call, const uint64_t *arguments)
{
    struct stat file;
    return (call == SYS_write || call == SYS_writev) && !fstat((int)arguments[0], &file) &&
           (S_ISFIFO(file.st_mode) || S_ISCHR(file.st_mode));
}

#endif
