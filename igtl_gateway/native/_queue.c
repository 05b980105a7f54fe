/* The compiled part of igtl_gateway/record/shared_queue.py, which documents the functions. */
#define PY_SSIZE_T_CLEAN
#include <Python.h>

#include "kernel/_queue.h"

static PyObject *name_payload, *name_kind, *name_channel, *name_type, *name_links, *name_seq, *name_stamp, *name_source;

/* An attribute as 64 unsigned bits; 0 if it is something else. */
static int get_number(PyObject *entry, PyObject *name, uint64_t *value)
{
    PyObject *found = PyObject_GetAttr(entry, name);
    if (!found || !PyLong_CheckExact(found)) {
        Py_XDECREF(found);
        return 0;
    }
    *value = PyLong_AsUnsignedLongLong(found);
    Py_DECREF(found);
    return !PyErr_Occurred();
}

/* The number of the stream of an entry; -1 if it has none. */
static long get_stream(PyObject *entry, PyObject *streams)
{
    PyObject *names[] = {name_kind, name_channel, name_type, name_links};
    PyObject *key = PyTuple_New(4);
    for (int i = 0; key && i < 4; i++) {
        PyObject *field = PyObject_GetAttr(entry, names[i]);
        if (!field)
            Py_CLEAR(key);
        else
            PyTuple_SET_ITEM(key, i, field);
    }
    if (!key)
        return -1;
    PyObject *number = PyDict_GetItemWithError(streams, key);
    Py_DECREF(key);
    return number ? PyLong_AsLong(number) : -1;
}

/* Put an entry whose payload is a tuple of bytes; 0 if Python has to do it, perhaps with an exception set. */
static int put_parts(struct queue *queue, PyObject *streams, PyObject *entry, PyObject *payload)
{
    uint64_t size = 0, number, stamp_ns, source_ns;
    if (!PyTuple_CheckExact(payload))
        return 0;
    const Py_ssize_t count = PyTuple_GET_SIZE(payload);
    for (Py_ssize_t i = 0; i < count; i++) {
        PyObject *part = PyTuple_GET_ITEM(payload, i);
        if (!PyBytes_CheckExact(part))
            return 0;
        size += (uint64_t)PyBytes_GET_SIZE(part);
    }
    if (size >= QUEUE_LARGE_BYTES)
        return 0;
    const long stream = get_stream(entry, streams);
    if (stream < 0 || !get_number(entry, name_seq, &number) || !get_number(entry, name_stamp, &stamp_ns) ||
        !get_number(entry, name_source, &source_ns) || !queue_fits(queue, 1, size))
        return 0;
    uint8_t *at = queue_begin(queue, (uint64_t)stream, number, stamp_ns, source_ns, size);
    for (Py_ssize_t i = 0; i < count; i++) {
        PyObject *part = PyTuple_GET_ITEM(payload, i);
        memcpy(at, PyBytes_AS_STRING(part), (size_t)PyBytes_GET_SIZE(part));
        at += PyBytes_GET_SIZE(part);
    }
    queue_publish(queue, size);
    return 1;
}

/* (memory, streams, entry) -> whether it was put */
static PyObject *put_entry(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    (void)module;
    Py_buffer memory;
    if (count != 3 || !PyDict_CheckExact(args[1])) {
        PyErr_SetString(PyExc_TypeError, "put_entry: found other arguments, expected those of shared_queue.py");
        return NULL;
    }
    if (PyObject_GetBuffer(args[0], &memory, PyBUF_WRITABLE) < 0)
        return NULL;
    int taken = 0;
    if (memory.len > QUEUE_PAGE) {
        struct queue queue = queue_open(memory.buf);
        PyObject *payload = PyObject_GetAttr(args[2], name_payload);
        taken = payload && put_parts(&queue, args[1], args[2], payload);
        Py_XDECREF(payload);
        PyErr_Clear(); /* Python finds the same, and raises what is to be raised */
    }
    PyBuffer_Release(&memory);
    return PyBool_FromLong(taken);
}

/* (target, place, parts): the parts, one after the other, without the interpreter lock */
static PyObject *copy_parts(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    (void)module;
    if (count != 3 || !PyList_CheckExact(args[2])) {
        PyErr_SetString(PyExc_TypeError, "copy_parts: found other arguments, expected those of shared_queue.py");
        return NULL;
    }
    const Py_ssize_t place = PyLong_AsSsize_t(args[1]), number = PyList_GET_SIZE(args[2]);
    if (place == -1 && PyErr_Occurred())
        return NULL;
    Py_buffer target, *parts = PyMem_Calloc((size_t)number + 1, sizeof *parts);
    if (!parts)
        return PyErr_NoMemory();
    if (PyObject_GetBuffer(args[0], &target, PyBUF_WRITABLE) < 0) {
        PyMem_Free(parts);
        return NULL;
    }
    Py_ssize_t known = 0, size = 0;
    while (known < number && PyObject_GetBuffer(PyList_GET_ITEM(args[2], known), &parts[known], PyBUF_SIMPLE) == 0)
        size += parts[known++].len;
    const int complete = known == number;
    const int fits = complete && place >= 0 && size <= target.len - place;
    if (fits) {
        uint8_t *at = (uint8_t *)target.buf + place;
        Py_BEGIN_ALLOW_THREADS
        for (Py_ssize_t i = 0; i < number; i++) {
            memcpy(at, parts[i].buf, (size_t)parts[i].len);
            at += parts[i].len;
        }
        Py_END_ALLOW_THREADS
    } else if (complete) {
        PyErr_Format(PyExc_ValueError, "copy_parts: found %zd bytes at %zd, expected room for them", size, place);
    }
    for (Py_ssize_t i = 0; i < known; i++)
        PyBuffer_Release(&parts[i]);
    PyMem_Free(parts);
    PyBuffer_Release(&target);
    return fits ? Py_NewRef(Py_None) : NULL;
}

/* (): order what this thread has read and written before what it reads and writes after this */
static PyObject *barrier(PyObject *module, PyObject *nothing)
{
    (void)module, (void)nothing;
    __atomic_thread_fence(__ATOMIC_SEQ_CST);
    Py_RETURN_NONE;
}

static PyMethodDef functions[] = {
    {"barrier", barrier, METH_NOARGS, "See shared_queue.py."},
    {"copy_parts", (PyCFunction)(void (*)(void))copy_parts, METH_FASTCALL, "See shared_queue.py."},
    {"put_entry", (PyCFunction)(void (*)(void))put_entry, METH_FASTCALL, "See shared_queue.py."},
    {NULL, NULL, 0, NULL},
};

static struct PyModuleDef definition = {PyModuleDef_HEAD_INIT, "_queue", "See shared_queue.py.", -1, functions,
                                        NULL, NULL, NULL, NULL};

PyMODINIT_FUNC PyInit__queue(void)
{
    name_payload = PyUnicode_InternFromString("payload");
    name_kind = PyUnicode_InternFromString("kind");
    name_channel = PyUnicode_InternFromString("channel");
    name_type = PyUnicode_InternFromString("type");
    name_links = PyUnicode_InternFromString("links");
    name_seq = PyUnicode_InternFromString("seq");
    name_stamp = PyUnicode_InternFromString("stamp_ns");
    name_source = PyUnicode_InternFromString("source_ns");
    if (!name_payload || !name_kind || !name_channel || !name_type || !name_links || !name_seq || !name_stamp ||
        !name_source)
        return NULL;
    return PyModule_Create(&definition);
}
