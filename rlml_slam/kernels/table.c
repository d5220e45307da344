/* SPDX-License-Identifier: Apache-2.0
 *
 * Module of the kernels compiled ahead of time. `entries.h`, which is generated, has their entries;
 * Numba's own file gives them its runtime, so that neither Numba nor LLVM is loaded.
 *
 * An entry takes the arguments as they are. A Kernel calls it only if they are what it was compiled
 * for: type and layout of every array, class of every tuple. Everything else goes to a Python
 * function.
 */
#include "modulemixin.c"
#include "entries.h"
#include <structmember.h>

typedef struct Check {
    char kind;            /* f(loat), i(nt), b(ool), n(one), A(rray), T(uple) */
    int ndim, flags;      /* of an array */
    PyObject *what;       /* its data type; the class of a tuple */
    Py_ssize_t count;     /* elements of a tuple */
    struct Check *parts;
} Check;

typedef struct Overload {
    Check arguments;      /* a tuple */
    PyObject *function;
    struct Overload *next;
} Overload;

typedef struct {
    PyObject_HEAD
    PyObject *dict;
    PyObject *otherwise;  /* called with the kernel, args and kwargs */
    Overload *overloads;
} Kernel;

static int
fits(const Check *check, PyObject *o)
{
    switch (check->kind) {
    case 'f':
        return PyFloat_Check(o);
    case 'i':
        return PyLong_CheckExact(o) || PyArray_IsScalar(o, Int64);
    case 'b':
        return PyBool_Check(o) || PyArray_IsScalar(o, Bool);
    case 'n':
        return o == Py_None;
    case 'A': {
        PyArrayObject *a = (PyArrayObject *)o;
        return PyArray_CheckExact(o) && PyArray_NDIM(a) == check->ndim
            && (PyArray_FLAGS(a) & check->flags) == check->flags
            && ((PyObject *)PyArray_DESCR(a) == check->what
                || PyArray_EquivTypes(PyArray_DESCR(a), (PyArray_Descr *)check->what));
    }
    case 'T':
        if ((PyObject *)Py_TYPE(o) != check->what || PyTuple_GET_SIZE(o) != check->count)
            return 0;
        for (Py_ssize_t k = 0; k < check->count; k++)
            if (!fits(check->parts + k, PyTuple_GET_ITEM(o, k)))
                return 0;
        return 1;
    }
    return 0;
}

/* A check from ('f',), ('A', ndim, flags, dtype) or ('T', class, (...)). What it refers to is kept
   as long as the process. */
static int
read_check(Check *check, PyObject *spec)
{
    const char *kind;
    if (!PyTuple_Check(spec) || PyTuple_GET_SIZE(spec) < 1
        || !(kind = PyUnicode_AsUTF8(PyTuple_GET_ITEM(spec, 0)))) {
        PyErr_SetString(PyExc_TypeError, "a check is a tuple that begins with its kind");
        return -1;
    }
    memset(check, 0, sizeof *check);
    check->kind = kind[0];
    if (check->kind == 'A') {
        if (!PyArg_ParseTuple(spec, "siiO!", &kind, &check->ndim, &check->flags,
                              &PyArrayDescr_Type, &check->what))
            return -1;
    }
    else if (check->kind == 'T') {
        PyObject *parts;
        if (!PyArg_ParseTuple(spec, "sOO!", &kind, &check->what, &PyTuple_Type, &parts))
            return -1;
        check->count = PyTuple_GET_SIZE(parts);
        check->parts = PyMem_Calloc(check->count + 1, sizeof(Check));
        if (!check->parts) {
            PyErr_NoMemory();
            return -1;
        }
        for (Py_ssize_t k = 0; k < check->count; k++)
            if (read_check(check->parts + k, PyTuple_GET_ITEM(parts, k)))
                return -1;
    }
    Py_XINCREF(check->what);
    return 0;
}

static PyObject *
kernel_call(Kernel *self, PyObject *args, PyObject *kwargs)
{
    if (!kwargs || !PyDict_GET_SIZE(kwargs))
        for (Overload *o = self->overloads; o; o = o->next)
            if (fits(&o->arguments, args))
                return PyObject_Call(o->function, args, NULL);
    return PyObject_CallFunctionObjArgs(self->otherwise, self, args, kwargs ? kwargs : Py_None,
                                        NULL);
}

static PyObject *
kernel_add(Kernel *self, PyObject *args)
{
    PyObject *spec, *function;
    if (!PyArg_ParseTuple(args, "OO", &spec, &function))
        return NULL;
    Overload *added = PyMem_Calloc(1, sizeof(Overload));
    if (!added)
        return PyErr_NoMemory();
    if (read_check(&added->arguments, spec)) {
        PyMem_Free(added);
        return NULL;
    }
    Py_INCREF(function);
    added->function = function;
    added->next = self->overloads;
    self->overloads = added;
    Py_RETURN_NONE;
}

/* Kernels are made once, when their module is imported, and stay. */
static PyObject *
kernel_new(PyTypeObject *type, PyObject *args, PyObject *kwargs)
{
    PyObject *otherwise;
    if (!PyArg_ParseTuple(args, "O", &otherwise))
        return NULL;
    Kernel *self = (Kernel *)type->tp_alloc(type, 0);
    if (self) {
        Py_INCREF(otherwise);
        self->otherwise = otherwise;
        self->dict = PyDict_New();
    }
    return (PyObject *)self;
}

static PyMethodDef kernel_methods[] = {
    {"add", (PyCFunction)kernel_add, METH_VARARGS, "add(check, function): an entry"},
    {NULL},
};

static PyGetSetDef kernel_getset[] = {
    {"__dict__", PyObject_GenericGetDict, PyObject_GenericSetDict},
    {NULL},
};

static PyTypeObject KernelType = {
    PyVarObject_HEAD_INIT(NULL, 0)
    .tp_name = "rlml_slam._kernels.Kernel",
    .tp_doc = "Kernel(otherwise): calls the entry that was compiled for the arguments",
    .tp_basicsize = sizeof(Kernel),
    .tp_dictoffset = offsetof(Kernel, dict),
    .tp_flags = Py_TPFLAGS_DEFAULT,
    .tp_new = kernel_new,
    .tp_call = (ternaryfunc)kernel_call,
    .tp_methods = kernel_methods,
    .tp_getset = kernel_getset,
    .tp_getattro = PyObject_GenericGetAttr,
    .tp_setattro = PyObject_GenericSetAttr,
};

static struct PyModuleDef definition = {
    PyModuleDef_HEAD_INIT, "_kernels", "Kernels compiled ahead of time.", -1,
};

PyMODINIT_FUNC
PyInit__kernels(void)
{
    PyObject *module = PyModule_Create(&definition);
    if (!module || pycc_init__kernels(module, entries, environments, places)
        || PyType_Ready(&KernelType) || PyModule_AddObject(module, "Kernel", (PyObject *)&KernelType))
        return NULL;
    return module;
}
