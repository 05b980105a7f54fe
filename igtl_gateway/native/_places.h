/* Reads the places of a compiled stream (express.py) from Python; after Python.h. */
#ifndef IGTL_GATEWAY_PLACES_H
#define IGTL_GATEWAY_PLACES_H

#include "_bulk.h"

/* Read the places of a cloud, a picture or of tools (express.py); 0: an exception is set. */
static int read_places(PyObject *places, struct ros_bulk *stream, ssize_t numbers[], Py_ssize_t count)
{
    for (Py_ssize_t i = 0; i < count; i++)
        numbers[i] = PyLong_AsSsize_t(PyTuple_GET_ITEM(places, i));
    if (PyErr_Occurred())
        return 0;
    stream->height_at = numbers[0], stream->data_at = numbers[1], stream->step = numbers[2];
    stream->x = numbers[3], stream->y = numbers[4], stream->z = numbers[5];
    stream->places = numbers + 6, stream->places_count = count - 6;
    int inside = stream->height_at >= 12 && stream->data_at <= stream->size && stream->data_at >= stream->height_at + 16 &&
                 stream->x >= 0 && stream->y >= 0 && stream->z >= 0 && stream->x + 4 <= stream->step &&
                 stream->y + 4 <= stream->step && stream->z + 4 <= stream->step;
    if (stream->form == TOOLS)
        inside = has_rows_from_ros(stream);
    if (stream->form == TRIANGLES)
        inside &= stream->x >= 4 && stream->x <= stream->data_at && stream->height_at <= stream->data_at - 80;
    for (Py_ssize_t i = 6; i < count; i += 2)
        inside &= numbers[i] >= 0 && numbers[i + 1] >= numbers[i] && numbers[i + 1] <= stream->size;
    if (!inside)
        PyErr_SetString(PyExc_ValueError, "bulk_to_igtl: places outside the sample");
    return inside;
}

#endif
