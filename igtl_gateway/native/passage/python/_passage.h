/* Passage, for Python: its threads wait here for what they have to do. */
#ifndef IGTL_GATEWAY_PASSAGE_PYTHON_PASSAGE_H
#define IGTL_GATEWAY_PASSAGE_PYTHON_PASSAGE_H

#include <sys/eventfd.h>

#include "../_turns.h"
#include "_compiled.h"
#include "_recheck.h"

#define MAX_TURNS 64 /* of subscriptions, at once */

#define EVENTS 32

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
    free_object((PyObject *)self);
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
        move_taker(one, PASSING);
        pthread_mutex_unlock(&self->events);
        int code = one->failure ? one->failure : pass_waiting(one);
        pthread_mutex_lock(&self->events);
        if (code == RCL_RET_SUBSCRIPTION_TAKE_FAILED)
            continue;
        if (code == RCL_RET_OK && one->holds == EMPTY) { /* a large one has passed */
            turns = 0;
            move_taker(one, WAITS);
            put_last(self, one);
            continue;
        }
        one->failure = code == RCL_RET_OK ? 0 : code;
        move_taker(one, WITH_PYTHON);
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
    if (!PyArg_ParseTuple(args, "OO!", &memory, Lock_Type, &lock))
        return NULL;
    if (self->is_recorded) {
        PyErr_SetString(PyExc_ValueError, "record_into: found a passage that is recorded, expected one that is not");
        return NULL;
    }
    Py_buffer view;
    PyObject *held = PyMemoryView_FromObject(memory); /* the mapping stays where it is */
    if (!held || PyObject_GetBuffer(memory, &view, PyBUF_WRITABLE)) {
        Py_XDECREF(held);
        return NULL;
    }
    self->queue_memory = held;
    self->queue = queue_open(view.buf);
    PyBuffer_Release(&view);
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
    if (!PyArg_ParseTuple(args, "KO!p", &function, Subscription_Type, &subscription, &on))
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
    {"recheck", (PyCFunction)passage_recheck, METH_VARARGS, "Compare recorded outputs with those of compiled streams."},
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

static PyType_Slot passage_slots[] = {
    {Py_tp_doc, "The native passage of a bridge; its context is the sequence lock."},
    {Py_tp_new, passage_new},
    {Py_tp_dealloc, passage_dealloc},
    {Py_tp_methods, passage_methods},
    {Py_tp_members, passage_members},
    {0, NULL},
};

static PyType_Spec passage_spec = {
    .name = "igtl_gateway.native._passage.Passage",
    .basicsize = sizeof(Passage),
    .flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_IMMUTABLETYPE,
    .slots = passage_slots,
};

#endif
