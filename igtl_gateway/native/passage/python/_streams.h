/* Stream, for Python. */
#ifndef IGTL_GATEWAY_PASSAGE_PYTHON_STREAMS_H
#define IGTL_GATEWAY_PASSAGE_PYTHON_STREAMS_H

#include "../_links.h"
#include "../_subscriptions.h"
#include "_guard.h"
#include "_owned.h"

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
    free_object((PyObject *)self);
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
        if (!is_read)
            move_kept(large, TAKEN);
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
        PyObject *sendings = PyLong_FromUnsignedLongLong(output->sent);
        PyObject *ignorings = PyLong_FromLongLong(taken(&output->ignored));
        PyTuple_SET_ITEM(sent, i, sendings);
        PyTuple_SET_ITEM(ignored, i, ignorings);
        if (!sendings || !ignorings)
            Py_CLEAR(sent);
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

static PyObject *stream_guard_with(Stream *self, PyObject *guard)
{
    if (!PyObject_TypeCheck(guard, Guard_Type)) {
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

static PyObject *stream_get_in_use(Stream *self, void *closure)
{
    return (void)closure, PyBool_FromLong(__atomic_load_n(&self->is_in_use, __ATOMIC_ACQUIRE));
}

static PyGetSetDef stream_getset[] = {
    {"is_in_use", (getter)stream_get_in_use, NULL, "A message is being given to the links; then what they ignore may still be counted.", NULL},
    {NULL, NULL, NULL, NULL, NULL},
};

static PyType_Slot stream_slots[] = {
    {Py_tp_doc, "A compiled stream of the native passage."},
    {Py_tp_dealloc, stream_dealloc},
    {Py_tp_methods, stream_methods},
    {Py_tp_members, stream_members},
    {Py_tp_getset, stream_getset},
    {0, NULL},
};

static PyType_Spec stream_spec = {
    .name = "igtl_gateway.native._passage.Stream",
    .basicsize = sizeof(Stream),
    .flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_IMMUTABLETYPE | Py_TPFLAGS_DISALLOW_INSTANTIATION,
    .slots = stream_slots,
};

static Stream *new_stream(Passage *passage, const char *sample, Py_ssize_t size)
{
    Stream *self = PyObject_New(Stream, Stream_Type);
    if (!self)
        return NULL;
    memset((char *)self + offsetof(Stream, passage), 0, sizeof *self - offsetof(Stream, passage));
    self->passage = (Passage *)Py_NewRef((PyObject *)passage);
    self->sample = copied(sample, size);
    self->latest = malloc(size > LARGEST_INPUT ? (size_t)size : LARGEST_INPUT);
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

#endif
