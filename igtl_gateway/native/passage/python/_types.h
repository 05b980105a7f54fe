/* The types of the module, made when it is loaded: a class has a reference from each of its objects. */
#ifndef IGTL_GATEWAY_PASSAGE_PYTHON_TYPES_H
#define IGTL_GATEWAY_PASSAGE_PYTHON_TYPES_H

#define PY_SSIZE_T_CLEAN
#include <Python.h>

static PyTypeObject *Lock_Type, *Passage_Type, *Link_Type, *Subscription_Type, *Publisher_Type, *Stream_Type, *Guard_Type;

/* The end of each dealloc: free the object, and leave its class. */
static void free_object(PyObject *self)
{
    PyTypeObject *type = Py_TYPE(self);
    type->tp_free(self);
    Py_DECREF((PyObject *)type);
}

#endif
