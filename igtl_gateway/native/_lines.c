/* The compiled part of igtl_gateway/api/csv_lines.py, which documents the function; it also exists in Python there. */
#define PY_SSIZE_T_CLEAN
#include <Python.h>

#include <stdint.h>
#include <string.h>

/* The longest number. */
#define FLOAT_SIZE 24
#define INTEGER_SIZE 20

/* A cell of each line: one string, a string for each line, or numbers. */
struct cell {
    char kind; /* 't', 'l', 'f', 'i', 'u' */
    const char *text;
    Py_ssize_t size;
    PyObject *list;
    Py_buffer values, mask;
    double last; /* of the line before, with its digits */
    char last_text[FLOAT_SIZE];
    Py_ssize_t last_size;
};

static void release_cells(struct cell *cells, Py_ssize_t count)
{
    for (Py_ssize_t i = 0; i < count; i++) {
        Py_XDECREF(cells[i].list);
        if (cells[i].values.obj)
            PyBuffer_Release(&cells[i].values);
        if (cells[i].mask.obj)
            PyBuffer_Release(&cells[i].mask);
    }
    PyMem_Free(cells);
}

static int fail(const char *why)
{
    PyErr_SetString(PyExc_ValueError, why);
    return 0;
}

/* Take what stands for a cell; add the most bytes that it needs in all lines. */
static int take_cell(struct cell *cell, PyObject *given, Py_ssize_t count, Py_ssize_t *most)
{
    if (PyBytes_CheckExact(given)) {
        cell->kind = 't';
        cell->list = Py_NewRef(given);
        cell->text = PyBytes_AS_STRING(given);
        cell->size = PyBytes_GET_SIZE(given);
        if (cell->size > (PY_SSIZE_T_MAX / 2 - *most) / (count + 1))
            return fail("csv_lines: too long");
        *most += cell->size * count;
        return 1;
    }
    if (PyList_CheckExact(given)) {
        cell->kind = 'l';
        cell->list = PyList_AsTuple(given); /* which stays as it is */
        if (!cell->list)
            return 0;
        if (PyTuple_GET_SIZE(cell->list) != count)
            return fail("csv_lines: found another number of strings than lines");
        for (Py_ssize_t row = 0; row < count; row++) {
            PyObject *text = PyTuple_GET_ITEM(cell->list, row);
            if (!PyBytes_CheckExact(text) || PyBytes_GET_SIZE(text) > PY_SSIZE_T_MAX / 2 - *most)
                return fail("csv_lines: expected bytes");
            *most += PyBytes_GET_SIZE(text);
        }
        return 1;
    }
    const char *kind;
    PyObject *values, *mask;
    if (!PyTuple_Check(given)) {
        PyErr_SetString(PyExc_TypeError, "csv_lines: expected bytes, a list or a tuple");
        return 0;
    }
    if (!PyArg_ParseTuple(given, "sOO", &kind, &values, &mask))
        return 0;
    cell->kind = kind[0];
    if ((cell->kind != 'f' && cell->kind != 'i' && cell->kind != 'u') || kind[1])
        return fail("csv_lines: found another kind of numbers");
    if (PyObject_GetBuffer(values, &cell->values, PyBUF_SIMPLE) < 0)
        return 0;
    if (mask != Py_None && PyObject_GetBuffer(mask, &cell->mask, PyBUF_SIMPLE) < 0)
        return 0;
    if (cell->values.len != 8 * count || (cell->mask.obj && cell->mask.len != count))
        return fail("csv_lines: found another number of values than lines");
    const Py_ssize_t size = cell->kind == 'f' ? FLOAT_SIZE : INTEGER_SIZE;
    if (*most > PY_SSIZE_T_MAX / 2 - size * count)
        return fail("csv_lines: too long");
    *most += size * count;
    return 1;
}

static char *put_integer(char *at, uint64_t value)
{
    char digits[INTEGER_SIZE];
    int count = 0;
    do {
        digits[count++] = (char)('0' + value % 10);
        value /= 10;
    } while (value);
    while (count)
        *at++ = digits[--count];
    return at;
}

/* As ``repr``; NULL with an error. */
static char *put_float(char *at, struct cell *cell, double value)
{
    if (!cell->last_size || memcmp(&value, &cell->last, sizeof value) != 0) {
        char *text = PyOS_double_to_string(value, 'r', 0, Py_DTSF_ADD_DOT_0, NULL);
        if (!text)
            return NULL;
        const size_t size = strlen(text);
        if (size <= FLOAT_SIZE) {
            memcpy(cell->last_text, text, size);
            cell->last_size = (Py_ssize_t)size;
            cell->last = value;
        }
        PyMem_Free(text);
        if (size > FLOAT_SIZE) {
            fail("csv_lines: found a number with more digits than a float has");
            return NULL;
        }
    }
    memcpy(at, cell->last_text, (size_t)cell->last_size);
    return at + cell->last_size;
}

static char *put_cell(char *at, struct cell *cell, Py_ssize_t row)
{
    if (cell->kind == 't') {
        memcpy(at, cell->text, (size_t)cell->size);
        return at + cell->size;
    }
    if (cell->kind == 'l') {
        PyObject *text = PyTuple_GET_ITEM(cell->list, row);
        memcpy(at, PyBytes_AS_STRING(text), (size_t)PyBytes_GET_SIZE(text));
        return at + PyBytes_GET_SIZE(text);
    }
    if (cell->mask.obj && !((const uint8_t *)cell->mask.buf)[row])
        return at;
    const char *place = (const char *)cell->values.buf + 8 * row;
    if (cell->kind == 'f') {
        double value;
        memcpy(&value, place, 8);
        return put_float(at, cell, value);
    }
    uint64_t value;
    memcpy(&value, place, 8);
    if (cell->kind == 'i' && value >> 63) {
        *at++ = '-';
        value = 0 - value;
    }
    return put_integer(at, value);
}

/* (count, cells) -> bytes */
static PyObject *csv_lines(PyObject *module, PyObject *args)
{
    (void)module;
    Py_ssize_t count;
    PyObject *given;
    if (!PyArg_ParseTuple(args, "nO", &count, &given))
        return NULL;
    PyObject *list = PySequence_Fast(given, "csv_lines: expected a sequence of cells");
    if (!list)
        return NULL;
    const Py_ssize_t columns = PySequence_Fast_GET_SIZE(list);
    struct cell *cells = PyMem_Calloc((size_t)columns + 1, sizeof *cells);
    PyObject *text = NULL;
    Py_ssize_t most = 0;
    int right = cells != NULL;
    if (!cells)
        PyErr_NoMemory();
    else if (count < 0 || count > PY_SSIZE_T_MAX / 4 / (columns + 2) / FLOAT_SIZE)
        right = fail("csv_lines: too many");
    else
        most = count * (columns + 2);
    for (Py_ssize_t i = 0; right && i < columns; i++)
        right = take_cell(&cells[i], PySequence_Fast_GET_ITEM(list, i), count, &most);
    if (right && (text = PyBytes_FromStringAndSize(NULL, most))) {
        char *at = PyBytes_AS_STRING(text);
        for (Py_ssize_t row = 0; at && row < count; row++) {
            for (Py_ssize_t i = 0; at && i < columns; i++) {
                if (i)
                    *at++ = ',';
                at = put_cell(at, &cells[i], row);
            }
            if (at) {
                *at++ = '\r';
                *at++ = '\n';
            }
        }
        if (at)
            _PyBytes_Resize(&text, at - PyBytes_AS_STRING(text));
        else
            Py_CLEAR(text);
    }
    if (cells)
        release_cells(cells, columns);
    Py_DECREF(list);
    return text;
}

/* -- module ------------------------------------------------------------------------------------------------------- */

static PyMethodDef functions[] = {
    {"csv_lines", csv_lines, METH_VARARGS, "See csv_lines.py."},
    {NULL, NULL, 0, NULL},
};

static struct PyModuleDef definition = {PyModuleDef_HEAD_INIT, "_lines", "See csv_lines.py.", -1, functions,
                                        NULL, NULL, NULL, NULL};

PyMODINIT_FUNC PyInit__lines(void)
{
    return PyModule_Create(&definition);
}
