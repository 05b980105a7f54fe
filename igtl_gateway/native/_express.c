/* The compiled part of igtl_gateway/convert/express.py, which documents the functions; ``join_parts``: of native/joining.py.
 *
 * The functions for poses also exist in Python, with results that are equal bit for bit.  Those for bulk (strings,
 * points, clouds, images) exist only here.  For every message that is not as the sample they return None, and the full
 * path handles it.  The conversions themselves are in kernel/; this file has their interface to Python.
 */
#define PY_SSIZE_T_CLEAN
#include <Python.h>
#ifdef __linux__
#include <sys/mman.h>
#endif

#include "kernel/_bulk_to_igtl.h"
#include "kernel/_bulk_to_ros.h"
#include "_places.h"

/* -- poses ------------------------------------------------------------------------------------------------------------- */

static int all_tuples(PyObject *forms)
{
    if (!PyTuple_Check(forms))
        return 0;
    for (Py_ssize_t i = 0; i < PyTuple_GET_SIZE(forms); i++)
        if (!PyTuple_Check(PyTuple_GET_ITEM(forms, i)))
            return 0;
    return 1;
}

/* Places for ``rest`` objects behind these numbers, or NULL with the error set. */
static PyObject *behind_numbers(const int64_t *numbers, Py_ssize_t count, Py_ssize_t rest)
{
    PyObject *result = PyTuple_New(count + rest);
    for (Py_ssize_t i = 0; result && i < count; i++) {
        PyObject *number = PyLong_FromLongLong(numbers[i]);
        if (number)
            PyTuple_SET_ITEM(result, i, number);
        else
            Py_CLEAR(result);
    }
    return result;
}

static PyObject *pose_to_ros(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    (void)module;
    if (count != 9 || !PyBytes_Check(args[1]) || !PyTuple_Check(args[7]) || !all_tuples(args[8])) {
        PyErr_SetString(PyExc_TypeError, "pose_to_ros(data, sample, at, bytes, check_crc, own, received_ns, (times, by), forms)");
        return NULL;
    }
    if (!PyBytes_Check(args[0]))
        Py_RETURN_NONE;
    const uint8_t *data = (const uint8_t *)PyBytes_AS_STRING(args[0]);
    const uint8_t *sample = (const uint8_t *)PyBytes_AS_STRING(args[1]);
    Py_ssize_t size = PyBytes_GET_SIZE(args[0]);
    Py_ssize_t at = PyLong_AsSsize_t(args[2]), bytes = PyLong_AsSsize_t(args[3]);
    int check_crc = PyObject_IsTrue(args[4]), own = PyObject_IsTrue(args[5]);
    int64_t received_ns = PyLong_AsLongLong(args[6]);
    double times, by;
    if (PyErr_Occurred() || !PyArg_ParseTuple(args[7], "dd", &times, &by))
        return NULL;
    if (at < HEADER_SIZE || (bytes != MATRIX_BYTES && bytes != QUATERNION_BYTES) ||
        at + bytes > PyBytes_GET_SIZE(args[1])) {
        PyErr_SetString(PyExc_ValueError, "pose_to_ros: numbers outside the sample");
        return NULL;
    }
    struct igtl_poses stream = {sample, PyBytes_GET_SIZE(args[1]), at, bytes, check_crc, times, by};
    double pose[7];
    if (!pose_from_igtl(&stream, data, size, pose))
        Py_RETURN_NONE;
    int64_t source_ns = ticks_to_ns(get_u64(data + TICKS_AT));
    int64_t stamp_ns = own && source_ns > 0 ? source_ns : received_ns;
    Py_ssize_t forms = PyTuple_GET_SIZE(args[8]);
    PyObject *result = behind_numbers((const int64_t[]){source_ns, stamp_ns}, 2, forms);
    if (!result)
        return NULL;
    for (Py_ssize_t i = 0; i < forms; i++) {
        PyObject *form = PyTuple_GET_ITEM(args[8], i), *template;
        Py_ssize_t stamp_at, id_at = 0;
        if (!PyArg_ParseTuple(form, "Sn|n", &template, &stamp_at, &id_at)) {
            Py_DECREF(result);
            return NULL;
        }
        Py_ssize_t length = PyBytes_GET_SIZE(template);
        if (!has_room_for_pose(length, stamp_at, id_at, at)) {
            PyErr_SetString(PyExc_ValueError, "pose_to_ros: a form without room for stamp and pose or message id");
            Py_DECREF(result);
            return NULL;
        }
        PyObject *cdr = PyBytes_FromStringAndSize(PyBytes_AS_STRING(template), length);
        if (!cdr) {
            Py_DECREF(result);
            return NULL;
        }
        put_ros_pose_or_id((uint8_t *)PyBytes_AS_STRING(cdr), length, stamp_at, id_at, stamp_ns, pose, data);
        PyTuple_SET_ITEM(result, 2 + i, cdr);
    }
    return result;
}

static PyObject *pose_to_igtl(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    (void)module;
    if (count != 9 || !PyBytes_Check(args[1]) || !PyTuple_Check(args[2]) || !PyTuple_Check(args[7]) ||
        !all_tuples(args[8])) {
        PyErr_SetString(PyExc_TypeError,
                        "pose_to_igtl(cdr, sample, names, bytes, own, source_ns, received_ns, (times, by), forms)");
        return NULL;
    }
    double times, by;
    Py_ssize_t first_end, second, end, bytes = PyLong_AsSsize_t(args[3]);
    if (!PyArg_ParseTuple(args[7], "dd", &times, &by) || !PyArg_ParseTuple(args[2], "nnn", &first_end, &second, &end))
        return NULL;
    int own = PyObject_IsTrue(args[4]);
    int64_t source_ns = PyLong_AsLongLong(args[5]), received_ns = PyLong_AsLongLong(args[6]);
    if (PyErr_Occurred())
        return NULL;
    Py_ssize_t size = PyBytes_GET_SIZE(args[1]);
    if (first_end < NAMES_AT || second < first_end || end < second || end > size - POSE_BYTES ||
        (bytes != MATRIX_BYTES && bytes != QUATERNION_BYTES)) {
        PyErr_SetString(PyExc_ValueError, "pose_to_igtl: names outside the sample");
        return NULL;
    }
    if (!PyBytes_Check(args[0]))
        Py_RETURN_NONE;
    struct ros_poses stream = {(const uint8_t *)PyBytes_AS_STRING(args[1]), size, first_end, second, end, bytes, times, by};
    int64_t header_ns;
    double numbers[12];
    if (!pose_from_ros(&stream, (const uint8_t *)PyBytes_AS_STRING(args[0]), PyBytes_GET_SIZE(args[0]), &header_ns, numbers))
        Py_RETURN_NONE;
    int64_t sent_ns = header_ns ? header_ns : source_ns;
    int64_t stamp_ns = own && sent_ns > 0 ? sent_ns : received_ns;
    Py_ssize_t forms = PyTuple_GET_SIZE(args[8]);
    PyObject *result = behind_numbers(&stamp_ns, 1, forms);
    if (!result)
        return NULL;
    for (Py_ssize_t i = 0; i < forms; i++) {
        PyObject *form = PyTuple_GET_ITEM(args[8], i), *template;
        Py_ssize_t at, digits_at;
        if (!PyArg_ParseTuple(form, "Snn", &template, &at, &digits_at)) {
            Py_DECREF(result);
            return NULL;
        }
        Py_ssize_t length = PyBytes_GET_SIZE(template);
        if (at < HEADER_SIZE || at + bytes > length || !has_digits(digits_at, length)) {
            PyErr_SetString(PyExc_ValueError, "pose_to_igtl: a form without room for the numbers");
            Py_DECREF(result);
            return NULL;
        }
        if (!fits_digits(digits_at, header_ns, stamp_ns)) {
            Py_DECREF(result); /* metadata of another size than in the template */
            Py_RETURN_NONE;
        }
        PyObject *message = PyBytes_FromStringAndSize(PyBytes_AS_STRING(template), length);
        if (!message) {
            Py_DECREF(result);
            return NULL;
        }
        uint8_t *out = (uint8_t *)PyBytes_AS_STRING(message);
        put_u64(out + TICKS_AT, ns_to_ticks(stamp_ns));
        put_igtl_pose(out, length, at, bytes, digits_at, numbers, header_ns, stamp_ns);
        PyTuple_SET_ITEM(result, 1 + i, message);
    }
    return result;
}

/* -- bulk: strings, points, clouds, pictures --------------------------------------------------------------------------- */

/* From this size on, other threads of Python run meanwhile. */
#define LARGE_BYTES (16 * 1024)

/* Forms of one message: as many as rows of the table, or header versions and profiles of peers. */
#define MAX_FORMS 64

/* Parts of a sample that must be equal. */
#define MAX_PLACES 16

/* A form of the arguments, and whether it fits the stream; 0: an exception is set. */
static int read_ros_form(PyObject *args, const struct igtl_bulk *stream, struct ros_form *form)
{
    PyObject *template;
    form->rest = 0;
    if (!PyArg_ParseTuple(args, "iSnn|n", &form->form, &template, &form->stamp_at, &form->width_at, &form->rest))
        return 0;
    form->template = (const uint8_t *)PyBytes_AS_STRING(template);
    form->room = PyBytes_GET_SIZE(template);
    if (form->form >= TEXT && form->form <= LANDMARKS && form->form != BLUE_FIRST && has_room(form) &&
        (form->form != METADATA || stream->sample[1] == 2) && (form->form != LANDMARKS || stream->landmarks))
        return 1;
    PyErr_SetString(PyExc_ValueError, "bulk_to_ros: a form without room for stamp and width");
    return 0;
}

static PyObject *bulk_to_ros(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    (void)module;
    if (count != 9 || !PyBytes_Check(args[1]) || !PyTuple_Check(args[7]) || !all_tuples(args[8])) {
        PyErr_SetString(PyExc_TypeError,
                        "bulk_to_ros(data, sample, at, tail, check_crc, own, received_ns, (times, by), forms)");
        return NULL;
    }
    struct igtl_bulk stream = {.sample = (const uint8_t *)PyBytes_AS_STRING(args[1]),
                               .at = PyLong_AsSsize_t(args[2]),
                               .tail = PyLong_AsSsize_t(args[3]),
                               .check_crc = PyObject_IsTrue(args[4])};
    int own = PyObject_IsTrue(args[5]);
    int64_t received_ns = PyLong_AsLongLong(args[6]);
    if (PyErr_Occurred() || !PyArg_ParseTuple(args[7], "dd", &stream.times, &stream.by))
        return NULL;
    Py_ssize_t forms_count = PyTuple_GET_SIZE(args[8]);
    stream.landmarks = PyBytes_GET_SIZE(args[1]) - stream.at - stream.tail;
    if (stream.tail < 0 || stream.landmarks < 0 || stream.landmarks % POINT_BYTES ||
        stream.at < HEADER_SIZE + (stream.sample[1] == 2 ? EXTENDED_SIZE : 0)) {
        PyErr_SetString(PyExc_ValueError, "bulk_to_ros: a sample that is not all but the content");
        return NULL;
    }
    if (forms_count > MAX_FORMS)
        Py_RETURN_NONE;
    Py_buffer view;
    if (PyObject_GetBuffer(args[0], &view, PyBUF_SIMPLE))
        return NULL;
    const uint8_t *data = view.buf;
    struct ros_form forms[MAX_FORMS];
    PyObject *result = NULL;
    if (!bulk_from_igtl_fits(&stream, data, view.len))
        goto general;
    int64_t source_ns = ticks_to_ns(get_u64(data + TICKS_AT));
    int64_t stamp_ns = own && source_ns > 0 ? source_ns : received_ns;
    if (!(result = behind_numbers((const int64_t[]){source_ns, stamp_ns}, 2, forms_count)))
        goto done;
    for (Py_ssize_t i = 0; i < forms_count; i++) {
        struct ros_form *form = &forms[i];
        if (!read_ros_form(PyTuple_GET_ITEM(args[8], i), &stream, form))
            goto failed;
        if (!prepare_form(form, data + stream.at, view.len - stream.at - stream.tail)) {
            Py_CLEAR(result);
            goto general;
        }
        PyObject *cdr = form->size ? PyBytes_FromStringAndSize(NULL, form->size) : Py_NewRef(Py_None);
        if (!cdr)
            goto failed;
        PyTuple_SET_ITEM(result, 2 + i, cdr);
        form->out = form->size ? (uint8_t *)PyBytes_AS_STRING(cdr) : NULL;
    }
    PyThreadState *others = view.len >= LARGE_BYTES ? PyEval_SaveThread() : NULL;
    int converted = bulk_from_igtl(&stream, data, view.len, forms, forms_count, stamp_ns);
    if (others)
        PyEval_RestoreThread(others);
    if (converted)
        goto done;
    Py_CLEAR(result);
general:
    result = Py_NewRef(Py_None);
    goto done;
failed:
    Py_CLEAR(result);
done:
    PyBuffer_Release(&view);
    return result;
}

/* Return whether a slice of the object is one of its bytes. */
static int is_flat(PyObject *data)
{
    if (!PyMemoryView_Check(data))
        return PyBytes_Check(data);
    Py_buffer *view = PyMemoryView_GET_BUFFER(data);
    return view->ndim == 1 && view->itemsize == 1 && view->readonly;
}

/* Replace each message of head and tail by a tuple of these, with the pixels as a view between them; 0: an exception is
 * set. */
static int put_pixels_between(PyObject *result, PyObject *cdr, const struct igtl_form *forms, Py_ssize_t at, Py_ssize_t size)
{
    PyObject *whole = PyMemoryView_FromObject(cdr);
    PyObject *pixels = whole ? PySequence_GetSlice(whole, at, at + size) : NULL;
    Py_XDECREF(whole);
    for (Py_ssize_t i = 1; pixels && i < PyTuple_GET_SIZE(result); i++) {
        PyObject *ends = PyTuple_GET_ITEM(result, i);
        const char *bytes = PyBytes_AS_STRING(ends);
        Py_ssize_t head = forms[i - 1].head_size, tail = forms[i - 1].tail_size;
        PyObject *parts = tail ? Py_BuildValue("y#Oy#", bytes, head, pixels, bytes + head, tail)
                               : Py_BuildValue("OO", ends, pixels);
        if (!parts) {
            Py_CLEAR(pixels);
            break;
        }
        PyTuple_SET_ITEM(result, i, parts);
        Py_DECREF(ends);
    }
    int done = pixels != NULL;
    Py_XDECREF(pixels);
    return done;
}

/* The form of a stream, and the places in its sample; 0: an exception is set. */
static int read_ros_bulk(PyObject *places_of, PyObject *factors, struct ros_bulk *stream, ssize_t *places)
{
    const Py_ssize_t count = PyTuple_GET_SIZE(places_of);
    if (!PyArg_ParseTuple(factors, "dd", &stream->times, &stream->by))
        return 0;
    const int has_places = stream->form != TEXT && stream->form != MESH;
    if (stream->form < TEXT || stream->form == POINT || (stream->form > TOOLS && stream->form != NUMBERS) ||
        (has_places && (count < 6 || count % 2 || count > 6 + 2 * MAX_PLACES))) {
        PyErr_SetString(PyExc_ValueError, "bulk_to_igtl: invalid form or places");
        return 0;
    }
    return !has_places || read_places(places_of, stream, places, count);
}

/* A form of the arguments; 0: an exception is set. */
static int read_igtl_form(PyObject *args, struct igtl_form *form)
{
    PyObject *head, *tail;
    if (!PyArg_ParseTuple(args, "SSn", &head, &tail, &form->digits_at))
        return 0;
    form->head = (const uint8_t *)PyBytes_AS_STRING(head), form->head_size = PyBytes_GET_SIZE(head);
    form->tail = (const uint8_t *)PyBytes_AS_STRING(tail), form->tail_size = PyBytes_GET_SIZE(tail);
    if (form->head_size >= HEADER_SIZE && has_digits(form->digits_at, form->tail_size))
        return 1;
    PyErr_SetString(PyExc_ValueError, "bulk_to_igtl: a form without room for header or stamp");
    return 0;
}

static PyObject *bulk_to_igtl(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    (void)module;
    if (count != 9 || !PyBytes_Check(args[1]) || !PyTuple_Check(args[2]) || !PyTuple_Check(args[7]) ||
        !all_tuples(args[8])) {
        PyErr_SetString(PyExc_TypeError,
                        "bulk_to_igtl(cdr, sample, places, form, own, source_ns, received_ns, (times, by), forms)");
        return NULL;
    }
    struct ros_bulk stream = {.sample = (const uint8_t *)PyBytes_AS_STRING(args[1]),
                              .size = PyBytes_GET_SIZE(args[1]),
                              .form = (int)PyLong_AsLong(args[3])};
    int own = PyObject_IsTrue(args[4]);
    int64_t source_ns = PyLong_AsLongLong(args[5]), received_ns = PyLong_AsLongLong(args[6]);
    const Py_ssize_t forms_count = PyTuple_GET_SIZE(args[8]);
    ssize_t places[6 + 2 * MAX_PLACES];
    if (PyErr_Occurred() || !read_ros_bulk(args[2], args[7], &stream, places))
        return NULL;
    if (forms_count > MAX_FORMS)
        Py_RETURN_NONE;
    Py_buffer view;
    if (PyObject_GetBuffer(args[0], &view, PyBUF_SIMPLE))
        return NULL;
    struct igtl_form forms[MAX_FORMS];
    struct found found = {0};
    PyObject *result = NULL;
    if (!find_in_ros(&stream, view.buf, view.len, &found))
        goto general;
    int64_t sent_ns = found.header_ns ? found.header_ns : source_ns;
    int64_t stamp_ns = own && sent_ns > 0 ? sent_ns : received_ns;
    int apart = stream.form == PICTURE && found.size >= LARGE_BYTES && is_flat(args[0]);
    if (!(result = behind_numbers(&stamp_ns, 1, forms_count)))
        goto done;
    for (Py_ssize_t i = 0; i < forms_count; i++) {
        struct igtl_form *form = &forms[i];
        if (!read_igtl_form(PyTuple_GET_ITEM(args[8], i), form))
            goto failed;
        if (!fits_digits(form->digits_at, found.header_ns, stamp_ns)) {
            Py_CLEAR(result); /* metadata of another size than in the template */
            goto general;
        }
        PyObject *message = PyBytes_FromStringAndSize(NULL, form->head_size + (apart ? 0 : found.size) + form->tail_size);
        if (!message)
            goto failed;
        PyTuple_SET_ITEM(result, 1 + i, message);
        form->out = (uint8_t *)PyBytes_AS_STRING(message);
    }
    PyThreadState *others = found.size >= LARGE_BYTES ? PyEval_SaveThread() : NULL;
    int converted = 1;
    if (apart)
        frame_pixels(&found, forms, forms_count, stamp_ns);
    else
        converted = bulk_from_ros(&stream, &found, forms, forms_count, stamp_ns);
    if (others)
        PyEval_RestoreThread(others);
    if (converted) {
        if (apart && !put_pixels_between(result, args[0], forms, found.data - (const uint8_t *)view.buf, found.size))
            goto failed;
        goto done;
    }
    Py_CLEAR(result);
general:
    result = Py_NewRef(Py_None);
    goto done;
failed:
    Py_CLEAR(result);
done:
    PyBuffer_Release(&view);
    return result;
}

/* -- many bytes --------------------------------------------------------------------------------------------------- */

#define HUGE_PAGE ((uintptr_t)2 << 20)

/* Have few large pages below new memory: to get, and to give back, 18,000 small ones takes longer than to fill them. */
static void take_huge_pages(uint8_t *memory, size_t size)
{
#if defined(__linux__) && defined(MADV_HUGEPAGE)
    uintptr_t begin = ((uintptr_t)memory + HUGE_PAGE - 1) & ~(HUGE_PAGE - 1);
    uintptr_t end = ((uintptr_t)memory + size) & ~(HUGE_PAGE - 1);
    if (end > begin)
        madvise((void *)begin, end - begin, MADV_HUGEPAGE); /* a system that cannot has small ones */
#else
    (void)memory, (void)size;
#endif
}

/* (parts) -> bytes: the parts, one after the other, copied without the interpreter lock */
static PyObject *join_parts(PyObject *module, PyObject *parts)
{
    (void)module;
    if (!PyList_CheckExact(parts)) {
        PyErr_SetString(PyExc_TypeError, "join_parts: found another argument, expected a list");
        return NULL;
    }
    const Py_ssize_t number = PyList_GET_SIZE(parts);
    Py_ssize_t known = 0, size = 0;
    PyObject *joined = NULL;
    Py_buffer *views = PyMem_Calloc((size_t)number + 1, sizeof *views);
    if (!views)
        return PyErr_NoMemory();
    while (known < number && PyObject_GetBuffer(PyList_GET_ITEM(parts, known), &views[known], PyBUF_SIMPLE) == 0)
        size += views[known++].len;
    if (known == number && (joined = PyBytes_FromStringAndSize(NULL, size))) {
        uint8_t *at = (uint8_t *)PyBytes_AS_STRING(joined);
        Py_BEGIN_ALLOW_THREADS
        take_huge_pages(at, (size_t)size);
        for (Py_ssize_t i = 0; i < number; i++) {
            memcpy(at, views[i].buf, (size_t)views[i].len);
            at += views[i].len;
        }
        Py_END_ALLOW_THREADS
    }
    for (Py_ssize_t i = 0; i < known; i++)
        PyBuffer_Release(&views[i]);
    PyMem_Free(views);
    return joined;
}

/* -- for the tests ----------------------------------------------------------------------------------------------- */

/* Allow AVX2, or not. */
static PyObject *allow_avx2(PyObject *module, PyObject *allowed)
{
    (void)module;
    begin_bulk(PyObject_IsTrue(allowed));
    Py_RETURN_NONE;
}

/* (data, crc of the bytes before) -> CRC, as the processor allows and with the tables */
static PyObject *crc64_both(PyObject *module, PyObject *args)
{
    (void)module;
    Py_buffer view;
    unsigned long long crc;
    if (!PyArg_ParseTuple(args, "y*K", &view, &crc))
        return NULL;
    PyObject *both = Py_BuildValue("KK", (unsigned long long)crc64_update(crc, view.buf, view.len),
                                   (unsigned long long)crc64_portable(crc, view.buf, view.len));
    PyBuffer_Release(&view);
    return both;
}

/* -- module --------------------------------------------------------------------------------------------------------- */

static PyMethodDef functions[] = {
    {"pose_to_ros", (PyCFunction)(void (*)(void))pose_to_ros, METH_FASTCALL, "See express.py."},
    {"pose_to_igtl", (PyCFunction)(void (*)(void))pose_to_igtl, METH_FASTCALL, "See express.py."},
    {"bulk_to_ros", (PyCFunction)(void (*)(void))bulk_to_ros, METH_FASTCALL, "See express.py."},
    {"bulk_to_igtl", (PyCFunction)(void (*)(void))bulk_to_igtl, METH_FASTCALL, "See express.py."},
    {"join_parts", join_parts, METH_O, "See joining.py."},
    {"allow_avx2", allow_avx2, METH_O, "Allow AVX2 or not, for the tests"},
    {"crc64_both", crc64_both, METH_VARARGS, "(data, crc) -> (CRC, CRC with the tables), for the tests"},
    {NULL, NULL, 0, NULL},
};

static struct PyModuleDef definition = {PyModuleDef_HEAD_INIT, "_express", "See express.py.", -1, functions,
                                        NULL, NULL, NULL, NULL};

PyMODINIT_FUNC PyInit__express(void)
{
    begin_bytes();
    begin_bulk(1);
    return PyModule_Create(&definition);
}
