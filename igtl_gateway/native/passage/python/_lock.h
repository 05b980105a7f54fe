/* Lock, for Python. */
#ifndef IGTL_GATEWAY_PASSAGE_PYTHON_LOCK_H
#define IGTL_GATEWAY_PASSAGE_PYTHON_LOCK_H

#include "../_lock.h"
#include "_types.h"

static PyObject *lock_new(PyTypeObject *type, PyObject *args, PyObject *keywords)
{
    (void)args, (void)keywords;
    Lock *self = (Lock *)type->tp_alloc(type, 0);
    if (self && begin_mutex(&self->mutex)) {
        Py_DECREF(self);
        return PyErr_NoMemory();
    }
    return (PyObject *)self;
}

static void lock_dealloc(Lock *self)
{
    pthread_mutex_destroy(&self->mutex);
    free_object((PyObject *)self);
}

static PyObject *lock_enter(Lock *self, PyObject *nothing)
{
    (void)nothing;
    lock_from_python(&self->mutex);
    return Py_NewRef((PyObject *)self);
}

static PyObject *lock_exit(Lock *self, PyObject *args)
{
    (void)args;
    pthread_mutex_unlock(&self->mutex);
    Py_RETURN_NONE;
}

static PyMethodDef lock_methods[] = {
    {"__enter__", (PyCFunction)lock_enter, METH_NOARGS, NULL},
    {"__exit__", (PyCFunction)lock_exit, METH_VARARGS, NULL},
    {NULL, NULL, 0, NULL},
};

static PyType_Slot lock_slots[] = {
    {Py_tp_doc, "A lock that Python and the native passage share."},
    {Py_tp_new, lock_new},
    {Py_tp_dealloc, lock_dealloc},
    {Py_tp_methods, lock_methods},
    {0, NULL},
};

static PyType_Spec lock_spec = {
    .name = "igtl_gateway.native._passage.Lock",
    .basicsize = sizeof(Lock),
    .flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_IMMUTABLETYPE,
    .slots = lock_slots,
};

#endif
