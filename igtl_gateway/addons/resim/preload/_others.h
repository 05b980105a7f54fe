/* The other processes of a program: launchers that started it, such as `ros2 run` or a shell, and what it or they have
 * started, such as the workers of a pool.
 *
 * They take part in "quiet" as threads do: their CPU times are read, then the state of each of their threads, then the CPU
 * times again.  So a worker that computes an answer has it ready at the time of the question, and a helper that waits for
 * work holds nothing up.  A sleep passes in real time: a process that sleeps is not quiet, since it goes on by itself;
 * but of a launcher, whose sleep is how it looks whether the program still runs.
 */
#ifndef IGTL_GATEWAY_PRELOAD_OTHERS_H
#define IGTL_GATEWAY_PRELOAD_OTHERS_H

#include "_proc.h"

enum { MOST_LAUNCHERS = 16 };

/* Remarks of _preload.c. */
static void found_real_wait_of(pid_t process, const char *call);
static void found_other(pid_t process, bool is_computing);

struct other_task {
    int process; /* its place in O.processes */
    pid_t tid;
    int stat;
    const char *call; /* with a time limit, in which it sleeps; NULL = none */
    bool is_sleep;    /* it waits for nothing but that time */
    bool has_looked;
};

/* All of it is protected by the lock of session time (`T.lock`), except for what is atomic. */
static struct {
    pid_t launchers[MOST_LAUNCHERS]; /* from the parent upwards */
    int launcher_count;
    _Atomic unsigned started; /* processes that this one has started */
    unsigned listed;          /* of these, when the list was made */
    struct process {
        pid_t pid;
        pid_t top; /* what the program, or its launcher, has started: it, or what it comes from */
        bool is_launcher;
        clockid_t clock;
        int64_t cpu_ns;
    } *processes;
    size_t count, room;
    struct other_task *tasks;
    size_t task_count, task_room;
} O;

/* A line of /proc/PID/NAME, or of a thread; "" if it cannot be read. */
static void read_line(pid_t process, pid_t thread, const char *name, char *text, size_t room)
{
    char path[96];
    if (thread)
        snprintf(path, sizeof path, "/proc/%d/task/%d/%s", process, thread, name);
    else
        snprintf(path, sizeof path, "/proc/%d/%s", process, name);
    read_path(path, text, room);
}

/* A field of /proc/PID/stat by its number (from 1, at least 3); 0 if the process has ended. */
static unsigned long long stat_field(pid_t process, int number)
{
    char text[512];
    read_line(process, 0, "stat", text, sizeof text);
    char *at = strrchr(text, ')');
    for (int field = 2; at && field < number; field++)
        at = strchr(at + 1, ' ');
    return at ? strtoull(at, NULL, 10) : 0;
}

/* Note the launchers: the processes between the coordinator, at the other end of a socket, and this one. */
static void find_launchers(int socket)
{
    struct ucred peer;
    socklen_t size = sizeof peer;
    if (getsockopt(socket, SOL_SOCKET, SO_PEERCRED, &peer, &size))
        return;
    int count = 0;
    pid_t parent = getppid();
    while (parent > 1 && parent != peer.pid && count < MOST_LAUNCHERS) {
        O.launchers[count++] = parent;
        parent = (pid_t)stat_field(parent, 4);
    }
    O.launcher_count = parent == peer.pid ? count : 0; /* else it runs apart from what started it */
}

static bool is_launcher(pid_t process)
{
    for (int i = 0; i < O.launcher_count; i++)
        if (O.launchers[i] == process)
            return true;
    return false;
}

static bool has_children(void)
{
    siginfo_t info;
    return !waitid(P_ALL, 0, &info, WEXITED | WNOHANG | WNOWAIT | __WALL);
}

static bool is_alone(void) { return !O.launcher_count && !has_children(); }

static bool add_process(pid_t pid, pid_t top)
{
    for (size_t i = 0; i < O.count; i++)
        if (O.processes[i].pid == pid)
            return true;
    struct process *processes = with_room(O.processes, O.count, &O.room, sizeof *processes);
    if (!processes)
        return false;
    O.processes = processes;
    /* the clock of a process's CPU time, as glibc's clock_getcpuclockid makes it */
    clockid_t clock = (clockid_t)((~(unsigned)pid << 3) | 2U);
    O.processes[O.count++] = (struct process){pid, top, is_launcher(pid), clock, -1};
    return true;
}

/* Call a function with each number in a folder of /proc. */
static bool each_number(const char *path, bool (*take)(pid_t number, pid_t first, int second), pid_t first, int second)
{
    DIR *folder = opendir(path);
    bool is_fine = true;
    for (struct dirent *entry; folder && is_fine && (entry = readdir(folder));)
        if (entry->d_name[0] >= '0' && entry->d_name[0] <= '9')
            is_fine = take((pid_t)strtol(entry->d_name, NULL, 10), first, second);
    if (folder)
        closedir(folder);
    return is_fine;
}

/* Note what a thread of a process has started. */
static bool add_children(pid_t tid, pid_t parent, int unused)
{
    char text[4096];
    (void)unused;
    read_line(parent, tid, "children", text, sizeof text);
    pid_t self = getpid(), top = 0;
    bool is_above = parent == self || is_launcher(parent);
    for (size_t i = 0; i < O.count && !is_above; i++)
        if (O.processes[i].pid == parent)
            top = O.processes[i].top;
    for (char *at = text, *end; *at; at = end) {
        pid_t child = (pid_t)strtol(at, &end, 10);
        if (end == at)
            break;
        if (child != self && !add_process(child, is_above ? child : top))
            return false;
    }
    return true;
}

static bool add_task(pid_t tid, pid_t pid, int process)
{
    char path[64];
    snprintf(path, sizeof path, "/proc/%d/task/%d/stat", pid, tid);
    int stat = open(path, O_RDONLY | O_CLOEXEC);
    if (stat < 0)
        return errno == ENOENT; /* it has ended */
    struct other_task *tasks = with_room(O.tasks, O.task_count, &O.task_room, sizeof *tasks);
    if (!tasks) {
        close(stat);
        return false;
    }
    O.tasks = tasks;
    O.tasks[O.task_count++] = (struct other_task){.process = process, .tid = tid, .stat = stat};
    return true;
}

static bool list_others(void)
{
    char path[64];
    for (size_t i = 0; i < O.task_count; i++)
        close(O.tasks[i].stat);
    O.count = O.task_count = 0;
    O.listed = atomic_load(&O.started);
    if (is_alone())
        return true;
    for (int i = 0; i < O.launcher_count; i++)
        if (!add_process(O.launchers[i], 0))
            return false;
    if (!each_number("/proc/self/task", add_children, getpid(), 0))
        return false;
    for (size_t i = 0; i < O.count; i++) { /* the list grows meanwhile */
        O.processes[i].cpu_ns = cpu_ns_at(O.processes[i].clock);
        snprintf(path, sizeof path, "/proc/%d/task", O.processes[i].pid);
        if (!each_number(path, add_children, O.processes[i].pid, 0) ||
            !each_number(path, add_task, O.processes[i].pid, (int)i))
            return false;
    }
    return true;
}

/* Make the list again if a process has started, run or ended since. */
static bool begin_others(void)
{
    if (!O.count && is_alone())
        return true;
    bool is_listed = O.count && O.listed == atomic_load(&O.started);
    for (size_t i = 0; i < O.count && is_listed; i++)
        is_listed = cpu_ns_at(O.processes[i].clock) == O.processes[i].cpu_ns;
    return is_listed || list_others();
}

/* Look which system call a thread of the list sleeps in. */
static void look_at_other_call(struct other_task *task)
{
    char text[256];
    long call;
    uint64_t arguments[6];
    if (task->has_looked)
        return;
    task->has_looked = true;
    read_line(O.processes[task->process].pid, task->tid, "syscall", text, sizeof text);
    if (!parse_call(text, &call, arguments))
        return;
    task->call = timed_call(call, arguments);
    task->is_sleep = task->call && is_sleep(call, arguments);
}

/* Whether all threads of the list sleep, or have ended. */
static bool others_sleep(void)
{
    for (size_t i = 0; i < O.task_count; i++) {
        char state = state_at(O.tasks[i].stat);
        if (state && !strchr("SZX", state))
            return false;
    }
    return true;
}

/* Whether nothing of the list goes on, after all have been seen asleep.  With clocks of session time, a wait that ends by
 * real time is remarked. */
static bool others_rest(bool has_session_clocks)
{
    for (size_t i = 0; i < O.count; i++)
        if (cpu_ns_at(O.processes[i].clock) != O.processes[i].cpu_ns)
            return false;
    for (size_t i = 0; i < O.task_count; i++) {
        struct other_task *task = &O.tasks[i];
        look_at_other_call(task);
        if (task->is_sleep && !O.processes[task->process].is_launcher)
            return false;
        if (task->call && has_session_clocks)
            found_real_wait_of(O.processes[task->process].pid, task->call);
    }
    return true;
}

/* Report what keeps the program from its rest: a process that computes, or one that sleeps. */
static void report_others(void)
{
    pid_t busy = 0, asleep = 0;
    if (!begin_others())
        return;
    for (size_t i = 0; i < O.task_count; i++) {
        struct other_task *task = &O.tasks[i];
        const struct process *process = &O.processes[task->process];
        char state = state_at(task->stat);
        if (state == 'R' || state == 'D')
            busy = process->top ? process->top : process->pid;
        else if (state == 'S' && !process->is_launcher)
            look_at_other_call(task);
        if (task->is_sleep && !process->is_launcher)
            asleep = process->top;
    }
    if (busy || asleep)
        found_other(busy ? busy : asleep, busy != 0);
}

#endif
