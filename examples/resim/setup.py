from setuptools import setup

setup(
    name="resim_example",
    version="0.1.0",
    packages=["resim_example"],
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/resim_example"]),
        ("share/resim_example", ["package.xml"]),
    ],
    entry_points={"console_scripts": ["planner = resim_example.planner:main"]},
)
