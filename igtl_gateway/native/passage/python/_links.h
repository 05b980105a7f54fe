/* Link, for Python. */
#ifndef IGTL_GATEWAY_PASSAGE_PYTHON_LINKS_H
#define IGTL_GATEWAY_PASSAGE_PYTHON_LINKS_H

#include "../_reading.h"
#include "../_sending.h"
#include "_lock.h"
#include "_streams.h"

static PyObject *link_new(PyTypeObject *type, PyObject *args, PyObject *keywords)
{
    (void)keywords;
    Passage *passage;
    Lock *sending;
    int number, fd, is_framed = 0;
    if (!PyArg_ParseTuple(args, "O!iiO!|p", Passage_Type, &passage, &number, &fd, Lock_Type, &sending, &is_framed))
        return NULL;
    Link *self = (Link *)type->tp_alloc(type, 0);
    if (!self)
        return NULL;
    self->passage = (Passage *)Py_NewRef((PyObject *)passage);
    self->sending = (Lock *)Py_NewRef((PyObject *)sending);
    self->number = number, self->fd = fd, self->is_framed = (char)is_framed;
    self->reader = PYTHON;
    self->clear = 1;
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
    free_object((PyObject *)self);
}

static PyObject *link_read_natively(Link *self, PyObject *args)
{
    double room, rate;
    if (!PyArg_ParseTuple(args, "dd", &room, &rate))
        return NULL;
    struct epoll_event event = {.events = EPOLLIN, .data.ptr = self};
    lock_from_python(&self->reading);
    self->start = self->filled = 0;
    __atomic_store_n(&self->pending, 0, __ATOMIC_RELAXED);
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
    self->is_paused = 0;
    self->is_limited = 0;
    PyObject *rest = Py_BuildValue("y#i", (const char *)(self->body ? self->body : self->chunk + self->start),
                                   (Py_ssize_t)(self->body ? self->body_filled : self->filled - self->start),
                                   self->failure);
    free(self->body);
    self->body = NULL;
    self->start = self->filled = 0;
    __atomic_store_n(&self->pending, 0, __ATOMIC_RELAXED);
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
            give_back(kept);
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
    return (void)closure, PyLong_FromSsize_t(__atomic_load_n(&self->pending, __ATOMIC_RELAXED));
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
    {"take_unsent", (PyCFunction)link_take_unsent, METH_NOARGS, "Return a message, the bytes sent of it and its frame, its stream, and whether it is to be kept; or None."},
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
    {"is_framed", T_BOOL, offsetof(Link, is_framed), READONLY, "Python reads the link, and each message that is sent has a frame."},
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

static PyType_Slot link_slots[] = {
    {Py_tp_doc, "A connection: passage, number, descriptor, and the lock of its sender."},
    {Py_tp_new, link_new},
    {Py_tp_dealloc, link_dealloc},
    {Py_tp_methods, link_methods},
    {Py_tp_members, link_members},
    {Py_tp_getset, link_properties},
    {0, NULL},
};

static PyType_Spec link_spec = {
    .name = "igtl_gateway.native._passage.Link",
    .basicsize = sizeof(Link),
    .flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_IMMUTABLETYPE,
    .slots = link_slots,
};

#endif
