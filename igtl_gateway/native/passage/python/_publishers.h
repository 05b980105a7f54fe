/* Publisher, for Python. */
#ifndef IGTL_GATEWAY_PASSAGE_PYTHON_PUBLISHERS_H
#define IGTL_GATEWAY_PASSAGE_PYTHON_PUBLISHERS_H

#include "../_publishing.h"
#include "_types.h"

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
    free_object((PyObject *)self);
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

static PyType_Slot publisher_slots[] = {
    {Py_tp_doc, "A publisher by the address of its rcl_publisher_t (0: nothing is published), and whether it is latched."},
    {Py_tp_new, publisher_new},
    {Py_tp_dealloc, publisher_dealloc},
    {Py_tp_methods, publisher_methods},
    {0, NULL},
};

static PyType_Spec publisher_spec = {
    .name = "igtl_gateway.native._passage.Publisher",
    .basicsize = sizeof(Publisher),
    .flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_IMMUTABLETYPE,
    .slots = publisher_slots,
};

#endif
