/* Lock, for Python. */
#ifndef IGTL_GATEWAY_PASSAGE_PYTHON_LOCK_H
#define IGTL_GATEWAY_PASSAGE_PYTHON_LOCK_H

#include "../_lock.h"

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
    Py_TYPE(self)->tp_free((PyObject *)self);
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

static PyTypeObject Lock_Type = {
    PyVarObject_HEAD_INIT(NULL, 0).tp_name = "igtl_gateway.native._passage.Lock",
    .tp_basicsize = sizeof(Lock),
    .tp_flags = Py_TPFLAGS_DEFAULT,
    .tp_doc = "A lock that Python and the native passage share.",
    .tp_new = lock_new,
    .tp_dealloc = (destructor)lock_dealloc,
    .tp_methods = lock_methods,
};

#endif
