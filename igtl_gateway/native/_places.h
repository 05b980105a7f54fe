/* Reads the places of a compiled stream (express.py) from Python; after Python.h. */
#ifndef IGTL_GATEWAY_PLACES_H
#define IGTL_GATEWAY_PLACES_H

#include "kernel/_bulk_to_igtl.h"

/* Read the places of a cloud, a picture, of tools or of numbers (express.py); 0: an exception is set. */
static int read_places(PyObject *places, struct ros_bulk *stream, ssize_t numbers[], Py_ssize_t count)
{
    for (Py_ssize_t i = 0; i < count; i++)
        numbers[i] = PyLong_AsSsize_t(PyTuple_GET_ITEM(places, i));
    if (PyErr_Occurred())
        return 0;
    int inside = set_places(stream, numbers, count);
    if (!inside)
        PyErr_SetString(PyExc_ValueError, "bulk_to_igtl: places outside the sample");
    return inside;
}

#endif
