/* Subscription, for Python. */
#ifndef IGTL_GATEWAY_PASSAGE_PYTHON_SUBSCRIPTIONS_H
#define IGTL_GATEWAY_PASSAGE_PYTHON_SUBSCRIPTIONS_H

#include "../_taking.h"
#include "_links.h"
#include "_owned.h"

static PyObject *subscription_new(PyTypeObject *type, PyObject *args, PyObject *keywords)
{
    (void)keywords;
    Passage *passage;
    unsigned long long pointer;
    if (!PyArg_ParseTuple(args, "O!K", Passage_Type, &passage, &pointer))
        return NULL;
    Subscription *self = (Subscription *)type->tp_alloc(type, 0);
    if (!self)
        return NULL;
    self->passage = (Passage *)Py_NewRef((PyObject *)passage);
    self->pointer = (const void *)(uintptr_t)pointer;
    self->message.allocator = TAKE_ALLOCATOR;
    if (begin_mutex(&self->state)) {
        Py_DECREF(self);
        return PyErr_NoMemory();
    }
    return (PyObject *)self;
}

static void subscription_dealloc(Subscription *self)
{
    free(self->message.buffer);
    pthread_mutex_destroy(&self->state);
    Py_XDECREF((PyObject *)self->passage);
    free_object((PyObject *)self);
}

/* Python takes the next message that does not pass natively, until there is none. */
static PyObject *subscription_take(Subscription *self, PyObject *nothing)
{
    (void)nothing;
    int code = self->failure;
    self->failure = 0;
    if (!code) {
        Py_BEGIN_ALLOW_THREADS
        move_taker(self, PASSING);
        code = pass_waiting(self);
        if (code != RCL_RET_SUBSCRIPTION_TAKE_FAILED)
            move_taker(self, WITH_PYTHON);
        Py_END_ALLOW_THREADS
    }
    if (code == RCL_RET_SUBSCRIPTION_TAKE_FAILED)
        Py_RETURN_NONE;
    if (code) {
        pthread_mutex_lock(&self->state);
        int is_pending = self->is_pending; /* rcl reports each message once */
        move_taker(self, is_pending ? WAITS : IDLE);
        pthread_mutex_unlock(&self->state);
        if (is_pending)
            note_subscription(self);
        return PyErr_Format(PyExc_RuntimeError, "rcl cannot take a message (code %d)", code);
    }
    if (self->holds == EMPTY) /* a large one has passed */
        return PyLong_FromSize_t(self->last_size);
    move_holds(self, EMPTY);
    self->last_size = self->message.length;
    PyObject *cdr = python_bytes(&self->message);
    if (!cdr)
        return NULL;
    return Py_BuildValue("NLK", cdr, (long long)self->info.source_ns, (unsigned long long)self->info.publication_number);
}

static PyObject *subscription_again(Subscription *self, PyObject *nothing)
{
    (void)nothing;
    move_taker(self, WAITS);
    note_subscription(self);
    Py_RETURN_NONE;
}

static PyObject *subscription_collect(Subscription *self, PyObject *nothing)
{
    (void)nothing;
    return Py_BuildValue("LLK", taken(&self->received), taken(&self->missing), (unsigned long long)__atomic_load_n(&self->last_number, __ATOMIC_RELAXED));
}

static PyMethodDef subscription_methods[] = {
    {"take", (PyCFunction)subscription_take, METH_NOARGS,
     "Return bytes, source stamp (UTC ns) and number of the next message that does not pass natively, the size of a large one "
     "that does, or None: there is none."},
    {"again", (PyCFunction)subscription_again, METH_NOARGS, "Come back to this subscription after the others."},
    {"collect", (PyCFunction)subscription_collect, METH_NOARGS,
     "Return received and missing messages since the last call, and the number of the last message."},
    {NULL, NULL, 0, NULL},
};

static PyMemberDef subscription_members[] = {
    {"last_number", T_ULONGLONG, offsetof(Subscription, last_number), 0, "Number of the last message; 0: unknown."},
    {NULL, 0, 0, 0, NULL},
};

static PyType_Slot subscription_slots[] = {
    {Py_tp_doc, "A subscription by the address of its rcl_subscription_t."},
    {Py_tp_new, subscription_new},
    {Py_tp_dealloc, subscription_dealloc},
    {Py_tp_methods, subscription_methods},
    {Py_tp_members, subscription_members},
    {0, NULL},
};

static PyType_Spec subscription_spec = {
    .name = "igtl_gateway.native._passage.Subscription",
    .basicsize = sizeof(Subscription),
    .flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_IMMUTABLETYPE,
    .slots = subscription_slots,
};

#endif
