/* ``Passage.recheck``: recorded entries against compiled streams. */
#ifndef IGTL_GATEWAY_PASSAGE_PYTHON_RECHECK_H
#define IGTL_GATEWAY_PASSAGE_PYTHON_RECHECK_H

#include "../_recheck.h"
#include "_streams.h"

#define RECHECK_COLUMNS 8 /* data, idents, numbers, times, sources, begins, ends, chosen */

/* (columns, streams, row, last_number) -> (row, why, inputs, last_input) */
static PyObject *passage_recheck(Passage *self, PyObject *args)
{
    (void)self;
    static const Py_ssize_t sizes[RECHECK_COLUMNS] = {1, 4, 8, 8, 8, 8, 8, 1};
    PyObject *columns, *streams, *result = NULL;
    Py_ssize_t row, count = -1;
    long long last_number;
    if (!PyArg_ParseTuple(args, "O!O!nL", &PyTuple_Type, &columns, &PyTuple_Type, &streams, &row, &last_number))
        return NULL;
    if (PyTuple_GET_SIZE(columns) != RECHECK_COLUMNS || row < 0) {
        PyErr_SetString(PyExc_ValueError, "recheck: columns or row as documented");
        return NULL;
    }
    Py_buffer views[RECHECK_COLUMNS];
    Py_ssize_t held = 0, known = PyTuple_GET_SIZE(streams);
    Link **links = calloc((size_t)known + 1, sizeof *links);
    Subscription **subscriptions = calloc((size_t)known + 1, sizeof *subscriptions);
    if (!links || !subscriptions) {
        PyErr_NoMemory();
        goto done;
    }
    for (Py_ssize_t i = 0; i < known; i++) {
        PyObject *stream = PyTuple_GET_ITEM(streams, i);
        if (PyObject_TypeCheck(stream, Link_Type))
            links[i] = (Link *)stream;
        else if (PyObject_TypeCheck(stream, Subscription_Type))
            subscriptions[i] = (Subscription *)stream;
    }
    for (; held < RECHECK_COLUMNS; held++) {
        if (PyObject_GetBuffer(PyTuple_GET_ITEM(columns, held), &views[held], PyBUF_SIMPLE))
            goto done;
        if (held == 1)
            count = views[held].len / sizes[held];
        if (held && views[held].len != count * sizes[held]) {
            PyErr_SetString(PyExc_ValueError, "recheck: columns of one length");
            held++;
            goto done;
        }
    }
    const struct recorded all = {
        .data = views[0].buf, .size = views[0].len, .count = count, .idents = views[1].buf, .numbers = views[2].buf,
        .times = views[3].buf, .sources = views[4].buf, .begins = views[5].buf, .ends = views[6].buf,
        .chosen = views[7].buf, .links = links, .subscriptions = subscriptions, .streams = known};
    struct rechecked found;
    Py_BEGIN_ALLOW_THREADS
    found = recheck(&all, row, last_number);
    Py_END_ALLOW_THREADS
    result = Py_BuildValue("ninn", (Py_ssize_t)found.row, found.why, (Py_ssize_t)found.inputs,
                           (Py_ssize_t)found.last_input);
done:
    while (held)
        PyBuffer_Release(&views[--held]);
    free(links);
    free(subscriptions);
    return result;
}

#endif
