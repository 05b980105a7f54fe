/* Clock, counts and locks of the passage. */
#ifndef IGTL_GATEWAY_PASSAGE_LOCK_H
#define IGTL_GATEWAY_PASSAGE_LOCK_H

#define PY_SSIZE_T_CLEAN
#include <Python.h>

#include <pthread.h>
#include <time.h>

#include "../kernel/_bytes.h"

#define LOCK_NS 2000000 /* the longest wait of a thread of the middleware */

static int64_t clock_ns(clockid_t clock)
{
    struct timespec now;
    clock_gettime(clock, &now);
    return now.tv_sec * NS_PER_S + now.tv_nsec;
}

/* Counts that Python takes without a lock. */
static void add(long long *count) { __atomic_add_fetch(count, 1, __ATOMIC_RELAXED); }

static long long taken(long long *count) { return __atomic_exchange_n(count, 0, __ATOMIC_RELAXED); }

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

#endif
