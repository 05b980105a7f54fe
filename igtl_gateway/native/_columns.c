/* The compiled part of igtl_gateway/record/sessionfile/chunk_columns.py, which documents the functions.
 *
 * All of them also exist in Python, with an equal result.  They release the interpreter, rows_of and interleaved apart.
 */
#define PY_SSIZE_T_CLEAN
#include <Python.h>

#include "kernel/_records.h"

#if __BYTE_ORDER__ != __ORDER_LITTLE_ENDIAN__
#error "this part reads numbers as they are in memory"
#endif

#define CHANNELS (1 << 16)

/* -- buffers ------------------------------------------------------------------------------------------------------ */

#define MOST_BUFFERS 10

struct buffers {
    Py_buffer views[MOST_BUFFERS];
    int count;
};

static void release(struct buffers *held)
{
    while (held->count)
        PyBuffer_Release(&held->views[--held->count]);
}

static const Py_buffer *hold(struct buffers *held, PyObject *object, int flags)
{
    Py_buffer *view = &held->views[held->count];
    if (PyObject_GetBuffer(object, view, flags) < 0)
        return NULL;
    held->count++;
    return view;
}

/* An array of ``count`` elements of ``size`` bytes. */
static void *column(struct buffers *held, PyObject *object, int flags, Py_ssize_t count, Py_ssize_t size)
{
    const Py_buffer *view = hold(held, object, flags);
    if (!view)
        return NULL;
    if (view->len != count * size) {
        PyErr_Format(PyExc_ValueError, "found an array of %zd bytes, expected %zd", view->len, count * size);
        return NULL;
    }
    return view->buf;
}

static int check_count(const char *name, Py_ssize_t found, Py_ssize_t expected)
{
    if (found == expected)
        return 1;
    PyErr_Format(PyExc_TypeError, "%s: found %zd arguments, expected %zd", name, found, expected);
    return 0;
}

/* -- messages ----------------------------------------------------------------------------------------------------- */

/* data -> (messages, whether in order, end, bits of all times) */
static PyObject *count_of(PyObject *module, PyObject *data)
{
    (void)module;
    Py_buffer view;
    struct messages_found found;
    if (PyObject_GetBuffer(data, &view, PyBUF_SIMPLE) < 0)
        return NULL;
    Py_BEGIN_ALLOW_THREADS
    found = count_messages(view.buf, (size_t)view.len);
    Py_END_ALLOW_THREADS
    PyBuffer_Release(&view);
    return Py_BuildValue("nNnK", (Py_ssize_t)found.count, PyBool_FromLong(found.in_order), (Py_ssize_t)found.end,
                         (unsigned long long)found.late);
}

/* (data, at, channels, sequences, times, publish_times, begins, ends) -> at */
static PyObject *take(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    (void)module;
    struct buffers held = {.count = 0};
    struct message_columns rows;
    PyObject *result = NULL;
    if (!check_count("take", count, 8))
        return NULL;
    const Py_ssize_t from = PyLong_AsSsize_t(args[1]);
    if (from == -1 && PyErr_Occurred())
        return NULL;
    const Py_buffer *data = hold(&held, args[0], PyBUF_SIMPLE);
    const Py_buffer *channels = data ? hold(&held, args[2], PyBUF_WRITABLE) : NULL;
    if (!channels)
        goto done;
    const Py_ssize_t most = channels->len / 2;
    rows.channels = channels->buf;
    if (!(rows.sequences = column(&held, args[3], PyBUF_WRITABLE, most, 4)) ||
        !(rows.times = column(&held, args[4], PyBUF_WRITABLE, most, 8)) ||
        !(rows.publish_times = column(&held, args[5], PyBUF_WRITABLE, most, 8)) ||
        !(rows.begins = column(&held, args[6], PyBUF_WRITABLE, most, 8)) ||
        !(rows.ends = column(&held, args[7], PyBUF_WRITABLE, most, 8)))
        goto done;
    size_t at = from < 0 || from > data->len ? (size_t)data->len : (size_t)from, taken;
    Py_BEGIN_ALLOW_THREADS
    taken = take_messages(data->buf, (size_t)data->len, &at, (size_t)most, &rows);
    Py_END_ALLOW_THREADS
    if (taken == (size_t)most)
        result = PyLong_FromSize_t(at);
    else
        PyErr_Format(PyExc_ValueError, "take: found %zu message%s, expected %zd", taken, taken == 1 ? "" : "s", most);
done:
    release(&held);
    return result;
}

/* One of the rows; NULL without memory. */
static PyObject *row_of(PyObject *data, const uint8_t *record, size_t begin, size_t end)
{
    uint16_t channel;
    memcpy(&channel, record + RECORD_HEAD, 2);
    const uint8_t *head = record + RECORD_HEAD;
    PyObject *fields[] = {
        PyLong_FromUnsignedLong(channel),
        PyLong_FromUnsignedLong(record_u32(head + SEQUENCE_AT)),
        PyLong_FromUnsignedLongLong(record_u64(head + TIME_AT)),
        PyLong_FromUnsignedLongLong(record_u64(head + PUBLISH_AT)),
        PyLong_FromSize_t(begin + RECORD_HEAD + MESSAGE_HEAD),
        PyLong_FromSize_t(end),
        Py_NewRef(data),
    };
    const Py_ssize_t count = sizeof fields / sizeof *fields;
    PyObject *row = PyTuple_New(count);
    for (Py_ssize_t i = 0; i < count; i++) {
        if (!fields[i])
            Py_CLEAR(row);
        if (row)
            PyTuple_SET_ITEM(row, i, fields[i]);
        else
            Py_XDECREF(fields[i]);
    }
    return row;
}

/* data -> (rows, whether in order, end) */
static PyObject *rows_of(PyObject *module, PyObject *data)
{
    (void)module;
    if (!PyBytes_CheckExact(data)) {
        PyErr_SetString(PyExc_TypeError, "rows_of: expected bytes");
        return NULL;
    }
    const uint8_t *bytes = (const uint8_t *)PyBytes_AS_STRING(data);
    const size_t size = (size_t)PyBytes_GET_SIZE(data);
    const struct messages_found found = count_messages(bytes, size);
    PyObject *rows = PyList_New((Py_ssize_t)found.count);
    Py_ssize_t number = 0;
    for (size_t at = 0; rows && at < found.end;) {
        const size_t end = record_end(bytes, size, at);
        if (bytes[at] == MESSAGE) {
            PyObject *row = row_of(data, bytes + at, at, end);
            if (row)
                PyList_SET_ITEM(rows, number++, row);
            else
                Py_CLEAR(rows);
        }
        at = end;
    }
    return rows ? Py_BuildValue("NNn", rows, PyBool_FromLong(found.in_order), (Py_ssize_t)found.end) : NULL;
}

/* -- RawMessages -------------------------------------------------------------------------------------------------- */

/* What unwrap reads and fills: columns of ``count`` messages. */
struct raw_messages {
    const uint16_t *channels;
    int64_t *begins;
    const int64_t *ends;
    int32_t *heads;
    uint8_t *flags;
    Py_ssize_t count;
};

/* Go on at ``row``; return the row at which the head is not known, -2 for one outside of the data. */
static Py_ssize_t unwrap_messages(const Py_buffer *data, const struct raw_messages *rows, Py_ssize_t row,
                                  const struct raw_heads *known)
{
    for (; row < rows->count; row++) {
        const int64_t begin = rows->begins[row], end = rows->ends[row];
        if (begin < 0 || end < begin || end > data->len)
            return -2;
        const uint8_t *raw = (const uint8_t *)data->buf + begin;
        const size_t place = raw_place(raw, (size_t)(end - begin), rows->channels[row], known, &rows->heads[row]);
        if (!place)
            break;
        rows->begins[row] = begin + (int64_t)place;
        rows->flags[row] = raw_flags(raw);
    }
    return row;
}

/* Whether the offsets of the heads are in their bytes. */
static int check_heads(const struct raw_heads *known, Py_ssize_t size)
{
    int right = known->offsets[0] == 0 && known->offsets[known->count] == size;
    for (int32_t i = 0; right && i < known->count; i++)
        right = known->offsets[i] <= known->offsets[i + 1] && known->offsets[i + 1] <= size && known->next[i] >= 0 &&
                known->next[i] < known->count;
    if (!right)
        PyErr_SetString(PyExc_ValueError, "unwrap: found heads outside of their bytes");
    return right;
}

/* (data, channels, begins, ends, heads, flags, row, bytes, offsets, next, last) -> row */
static PyObject *unwrap(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    (void)module;
    struct buffers held = {.count = 0};
    struct raw_messages rows;
    struct raw_heads known;
    Py_ssize_t row = -2;
    if (!check_count("unwrap", count, 11))
        return NULL;
    const Py_ssize_t from = PyLong_AsSsize_t(args[6]);
    if (from == -1 && PyErr_Occurred())
        return NULL;
    const Py_buffer *data = hold(&held, args[0], PyBUF_SIMPLE);
    const Py_buffer *channels = data ? hold(&held, args[1], PyBUF_SIMPLE) : NULL;
    const Py_buffer *bytes = channels ? hold(&held, args[7], PyBUF_SIMPLE) : NULL;
    const Py_buffer *next = bytes ? hold(&held, args[9], PyBUF_SIMPLE) : NULL;
    if (!next)
        goto done;
    rows.count = channels->len / 2;
    rows.channels = channels->buf;
    known.bytes = bytes->buf;
    known.next = next->buf;
    known.count = (int32_t)(next->len / 4);
    if (!(rows.begins = column(&held, args[2], PyBUF_WRITABLE, rows.count, 8)) ||
        !(rows.ends = column(&held, args[3], PyBUF_SIMPLE, rows.count, 8)) ||
        !(rows.heads = column(&held, args[4], PyBUF_WRITABLE, rows.count, 4)) ||
        !(rows.flags = column(&held, args[5], PyBUF_WRITABLE, rows.count, 1)) ||
        !(known.offsets = column(&held, args[8], PyBUF_SIMPLE, known.count + 1, 8)) ||
        !(known.last = column(&held, args[10], PyBUF_WRITABLE, CHANNELS, 4)) || !check_heads(&known, bytes->len))
        goto done;
    if (from >= 0) {
        Py_BEGIN_ALLOW_THREADS
        row = unwrap_messages(data, &rows, from, &known);
        Py_END_ALLOW_THREADS
    }
    if (row < 0)
        PyErr_SetString(PyExc_ValueError, "unwrap: found a message outside of the data");
done:
    release(&held);
    return row < 0 ? NULL : PyLong_FromSsize_t(row);
}

/* -- equal ranges ------------------------------------------------------------------------------------------------- */

/* ``count`` ranges of some buffers. */
struct ranges {
    Py_buffer *buffers;
    Py_ssize_t buffer_count;
    const int32_t *which;
    const int64_t *begins, *ends;
};

/* The first byte of a range; NULL for one outside of its buffer. */
static const uint8_t *range_at(const struct ranges *ranges, Py_ssize_t row)
{
    const int32_t which = ranges->which[row];
    const int64_t begin = ranges->begins[row], end = ranges->ends[row];
    if (which < 0 || which >= ranges->buffer_count || begin < 0 || end < begin || end > ranges->buffers[which].len)
        return NULL;
    return (const uint8_t *)ranges->buffers[which].buf + begin;
}

/* Whether all ranges are in their buffers. */
static int compare_ranges(const struct ranges *one, const struct ranges *other, Py_ssize_t count, uint8_t *equal)
{
    for (Py_ssize_t row = 0; row < count; row++) {
        const uint8_t *ours = range_at(one, row), *theirs = range_at(other, row);
        if (!ours || !theirs)
            return 0;
        const int64_t size = one->ends[row] - one->begins[row];
        equal[row] = other->ends[row] - other->begins[row] == size && memcmp(ours, theirs, (size_t)size) == 0;
    }
    return 1;
}

static void release_ranges(struct ranges *ranges)
{
    while (ranges->buffer_count)
        PyBuffer_Release(&ranges->buffers[--ranges->buffer_count]);
    PyMem_Free(ranges->buffers);
    ranges->buffers = NULL;
}

/* (buffers, which, begins, ends) */
static int hold_ranges(struct buffers *held, struct ranges *ranges, PyObject *const *args, Py_ssize_t count)
{
    PyObject *list = PySequence_Fast(args[0], "equal_ranges: expected a sequence of buffers");
    if (!list)
        return 0;
    const Py_ssize_t most = PySequence_Fast_GET_SIZE(list);
    ranges->buffers = PyMem_Calloc((size_t)most + 1, sizeof *ranges->buffers);
    if (!ranges->buffers)
        PyErr_NoMemory();
    while (ranges->buffers && ranges->buffer_count < most &&
           PyObject_GetBuffer(PySequence_Fast_GET_ITEM(list, ranges->buffer_count),
                              &ranges->buffers[ranges->buffer_count], PyBUF_SIMPLE) == 0)
        ranges->buffer_count++;
    Py_DECREF(list);
    return ranges->buffers && ranges->buffer_count == most &&
           (ranges->which = column(held, args[1], PyBUF_SIMPLE, count, 4)) &&
           (ranges->begins = column(held, args[2], PyBUF_SIMPLE, count, 8)) &&
           (ranges->ends = column(held, args[3], PyBUF_SIMPLE, count, 8));
}

/* (buffers, which, begins, ends, others, which, begins, ends, equal) */
static PyObject *equal_ranges(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    (void)module;
    struct buffers held = {.count = 0};
    struct ranges one = {0}, other = {0};
    int right = 0;
    if (!check_count("equal_ranges", count, 9))
        return NULL;
    const Py_buffer *equal = hold(&held, args[8], PyBUF_WRITABLE);
    if (equal && hold_ranges(&held, &one, args, equal->len) && hold_ranges(&held, &other, args + 4, equal->len)) {
        Py_BEGIN_ALLOW_THREADS
        right = compare_ranges(&one, &other, equal->len, equal->buf);
        Py_END_ALLOW_THREADS
        if (!right)
            PyErr_SetString(PyExc_ValueError, "equal_ranges: found a range outside of its buffer");
    }
    release_ranges(&one);
    release_ranges(&other);
    release(&held);
    return right ? Py_NewRef(Py_None) : NULL;
}

/* -- messages with heads ------------------------------------------------------------------------------------------ */

/* Put heads of ``head_size`` bytes, each before its payload. */
static void put_interleaved(uint8_t *at, const Py_buffer *data, const uint8_t *heads, Py_ssize_t head_size,
                            const int64_t *begins, const int64_t *ends, Py_ssize_t rows)
{
    for (Py_ssize_t row = 0; row < rows; row++) {
        memcpy(at, heads + row * head_size, (size_t)head_size);
        memcpy(at + head_size, (const uint8_t *)data->buf + begins[row], (size_t)(ends[row] - begins[row]));
        at += head_size + (Py_ssize_t)(ends[row] - begins[row]);
    }
}

/* (data, heads, begins, ends) -> bytes */
static PyObject *interleaved(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    (void)module;
    struct buffers held = {.count = 0};
    PyObject *result = NULL;
    const int64_t *ends;
    if (!check_count("interleaved", count, 4))
        return NULL;
    const Py_buffer *data = hold(&held, args[0], PyBUF_SIMPLE);
    const Py_buffer *heads = data ? hold(&held, args[1], PyBUF_SIMPLE) : NULL;
    const Py_buffer *begins = heads ? hold(&held, args[2], PyBUF_SIMPLE) : NULL;
    const Py_ssize_t rows = begins ? begins->len / 8 : 0, head_size = rows ? heads->len / rows : 0;
    if (!begins || !(ends = column(&held, args[3], PyBUF_SIMPLE, rows, 8)))
        goto done;
    const int64_t *from = begins->buf;
    Py_ssize_t size = heads->len, row = 0;
    for (; row < rows && 0 <= from[row] && from[row] <= ends[row] && ends[row] <= data->len; row++)
        size += (Py_ssize_t)(ends[row] - from[row]);
    if (row < rows || head_size * rows != heads->len)
        PyErr_SetString(PyExc_ValueError, "interleaved: found a message outside of the data, or heads of other sizes");
    else if ((result = PyBytes_FromStringAndSize(NULL, size)))
        put_interleaved((uint8_t *)PyBytes_AS_STRING(result), data, heads->buf, head_size, from, ends, rows);
done:
    release(&held);
    return result;
}

/* -- module ------------------------------------------------------------------------------------------------------- */

static PyMethodDef functions[] = {
    {"count_of", count_of, METH_O, "See chunk_columns.py."},
    {"take", (PyCFunction)(void (*)(void))take, METH_FASTCALL, "See chunk_columns.py."},
    {"equal_ranges", (PyCFunction)(void (*)(void))equal_ranges, METH_FASTCALL, "See chunk_columns.py."},
    {"rows_of", rows_of, METH_O, "See chunk_columns.py."},
    {"interleaved", (PyCFunction)(void (*)(void))interleaved, METH_FASTCALL, "See chunk_columns.py."},
    {"unwrap", (PyCFunction)(void (*)(void))unwrap, METH_FASTCALL, "See chunk_columns.py."},
    {NULL, NULL, 0, NULL},
};

static struct PyModuleDef definition = {PyModuleDef_HEAD_INIT, "_columns", "See chunk_columns.py.", -1, functions,
                                        NULL, NULL, NULL, NULL};

PyMODINIT_FUNC PyInit__columns(void)
{
    return PyModule_Create(&definition);
}
